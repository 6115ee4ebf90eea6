"""Files of runs: written whole or not at all; errors name them."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock

from trap_tube_jax.command_line import one_line


def check_folder(path: Path) -> None:
    """Raises ValueError if a folder cannot be made since a file has its name, or a parent's."""
    existing = next(found for found in (path, *path.parents, Path()) if found.exists())
    if not existing.is_dir():
        raise ValueError(f"{existing} is not a folder; give another path")


@contextlib.contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Turns what a parser raises about a file's content into a ValueError with the file's path."""
    try:
        yield
    except (OSError, MemoryError):
        raise
    except KeyError as error:
        raise ValueError(f"{path} lacks {error}") from error
    except Exception as error:  # parsers raise many kinds
        raise ValueError(f"{path} cannot be read: {one_line(error)}") from error


def read_json(path: Path) -> Any:
    """Reads a JSON file.

    Raises:
      ValueError: the file is not JSON; the message names it.
      OSError: the file is missing or cannot be opened.
    """
    with naming_file(path):
        return json.loads(path.read_text(encoding="utf-8"))


@contextlib.contextmanager
def lock_folder(path: Path) -> Iterator[None]:
    """Makes this process the only writer of a folder; makes the folder if missing.

    Raises:
      ValueError: another process writes to the folder.
      OSError: the folder cannot be created or locked.
    """
    path.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(filelock.FileLock(path / ".lock", timeout=0))
        except filelock.Timeout:
            reason = f"{path} is being written by another process; wait for its end"
            raise ValueError(reason) from None
        except NotImplementedError as error:
            raise OSError(f"{path} cannot be locked: {error}") from error
        yield


@contextlib.contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Yields a path to write to; its file replaces `path` at the end of the block."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file atomically."""
    with draft_of(path) as draft:
        draft.write_bytes(content)


def write_json(path: Path, values: Any) -> None:
    """Writes a JSON file atomically, and makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, (json.dumps(values, indent=2) + "\n").encode())


def append_text(path: Path, text: str, head: str) -> None:
    """Appends lines to a text file; begins a new file with the line `head`.

    Appends all lines or, if the disk is full, none.

    Raises:
      ValueError: the file begins with another line.
      OSError: the file cannot be written.
    """
    size = path.stat().st_size if path.is_file() else 0
    try:
        with path.open("a+", encoding="utf-8", newline="") as file:
            file.seek(0)
            first = file.readline()
            if first and first != head:
                raise ValueError(
                    f"{path} has other columns than this version writes, {head.strip()}; continue "
                    "with the version that began the file"
                )
            file.write(text if first else head + text)
    except OSError:
        with contextlib.suppress(OSError):  # the file may not have been opened
            os.truncate(path, size)
        raise
