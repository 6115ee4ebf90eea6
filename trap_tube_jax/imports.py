"""Imports of modules by name, and of optional libraries."""

import contextlib
import importlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path


def import_modules(names: Sequence[str]) -> None:
    """Imports modules by name, for what they register; also from the current directory.

    Args:
      names: as in `import NAME`. Modules that are imported already stay as they are.

    Raises:
      ValueError: a name does not name a module, or a module is missing.
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


@contextlib.contextmanager
def needs_extra(extra: str) -> Iterator[None]:
    """Turns a failed import inside the `with` block into one that says what to install.

    The message names the module that is missing, which may be one that the extra's library needs.

    Raises:
      ImportError: an import failed.
    """
    try:
        yield
    except ImportError as error:
        missing = f"the module {error.name!r}" if error.name else "an optional library"
        raise ImportError(
            f"this needs {missing}: pip install 'trap-tube-jax[{extra}]' ({error})"
        ) from error
