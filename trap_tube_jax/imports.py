"""Modules of your own, imported for the names that they register."""

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator, Sequence
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


def registering_file() -> str:
    """The file of the code that calls the function that calls this one.

    So a script and the module that is imported from its file are the same. Where there is no file,
    as in a notebook, it is the module's name.
    """
    module = sys._getframe(2).f_globals
    file = module.get("__file__")
    return os.path.realpath(file) if file else str(module.get("__name__"))


@contextlib.contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Names the extra that installs what an import inside the `with` block misses.

    Raises:
      ImportError: an import failed.
    """
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"this needs an optional library: pip install 'trap-tube-jax[{extra}]' ({error})"
        ) from error
