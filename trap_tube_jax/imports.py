"""Modules of your own, imported for the names that they register."""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path


def import_modules(names: Sequence[str]) -> None:
    """Imports modules by name, from the current directory too.

    Args:
      names: as in `import NAME`; those that are imported already stay as they are.

    Raises:
      ValueError: a name is not that of a module, or the module, or one that it needs, is missing.
    """
    here = str(Path.cwd())
    if names and here not in sys.path:
        sys.path.append(here)
    for name in names:
        if not all(part.isidentifier() for part in name.split(".")):
            raise ValueError(f"cannot import {name!r}: name a module, as in `import NAME`")
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise ValueError(
                f"cannot import {name!r}: there is no module {error.name!r} in {here} or on "
                "Python's path; run from the folder that holds it, or put that on PYTHONPATH"
            ) from error
