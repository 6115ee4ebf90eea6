"""Files of runs: read only where they are regular and as expected, written whole or not at all."""

import contextlib
import dataclasses
import errno
import json
import os
import reprlib
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import filelock

from trap_tube_jax.checks import is_printable
from trap_tube_jax.command_line import one_line

Plain = bool | int | float | str | None


def is_file(path: Path) -> bool:
    """Returns whether a path names a regular file; False if it names nothing.

    Raises:
      ValueError: it names something else, such as a folder, a FIFO or a dangling link.
    """
    if path.is_file():
        return True
    if os.path.lexists(path):
        raise ValueError(f"{path} is not a regular file")
    return False


def check_folder(path: Path) -> None:
    """Raises ValueError if a folder cannot be made since a file has its name, or a parent's."""
    existing = next(found for found in (path, *path.parents, Path()) if found.exists())
    if not existing.is_dir():
        raise ValueError(f"{existing} is not a folder; give another path")


def check_file(path: Path) -> None:
    """Raises FileNotFoundError or ValueError unless a path names a regular file."""
    if not is_file(path):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))


@contextlib.contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Turns what a parser raises about a file's content into a ValueError with the file's path."""
    try:
        yield
    except (OSError, MemoryError):
        raise
    except Exception as error:  # parsers raise many kinds, also RecursionError
        raise ValueError(f"{path} cannot be read: {one_line(error)}") from error


def read_text(path: Path) -> str:
    """Reads a file of UTF-8.

    Raises:
      ValueError: the file is not regular or not UTF-8.
      OSError: the file is missing or cannot be opened.
    """
    check_file(path)
    with naming_file(path):
        return path.read_bytes().decode()


def read_json(path: Path, kind: Any = Any) -> Any:
    """Reads a JSON file whose value is of an annotated type; see `parse_json`.

    Raises:
      ValueError: the file is damaged; the message names it.
      OSError: the file is missing or cannot be opened.
    """
    text = read_text(path)
    with naming_file(path):
        return parse_json(text, kind)


def parse_json(text: str, kind: Any) -> Any:
    """Parses JSON, and checks that the value is of an annotated type.

    Strings must be printable, because terminals show them. Keys of a TypedDict or a dataclass must
    be known, and the required keys of a TypedDict present.

    Args:
      text: the JSON.
      kind: a plain type, a union, `list[X]`, `tuple[X, ...]`, `dict[str, X]`, a TypedDict, or a
        dataclass.

    Raises:
      ValueError: the text is not JSON, or its value is of another type.
    """
    value = json.loads(text)
    _check_kind(value, kind, "it")
    return value


def _check_kind(value: Any, kind: Any, name: str) -> None:
    """Raises ValueError, which names the part, unless a JSON value is of a type."""
    form = get_origin(kind) or kind
    arguments = get_args(kind)
    if form is Any:
        return
    if form in (Union, types.UnionType):
        _check_union(value, arguments, name)
    elif form in (list, tuple):
        _check_is(value, list, name)
        for index, part in enumerate(value):
            _check_kind(part, arguments[0], f"{name}[{index}]")
    elif form is dict:
        _check_is(value, dict, name)
        for key, part in value.items():
            _check_is(key, str, f"a key of {name}")
            _check_kind(part, arguments[1], key)
    elif typing.is_typeddict(form) or dataclasses.is_dataclass(form):
        _check_is(value, dict, name)
        _check_keys(value, form, name)
        kinds = get_type_hints(form)
        for key, part in value.items():
            _check_kind(part, kinds[key], key)
    else:
        _check_is(value, form, name)


def _check_union(value: Any, kinds: tuple[Any, ...], name: str) -> None:
    for kind in kinds:
        with contextlib.suppress(ValueError):
            return _check_kind(value, kind, name)
    wanted = " or ".join(getattr(kind, "__name__", str(kind)) for kind in kinds)
    raise ValueError(f"{name} must be {wanted}, got {reprlib.repr(value)}")


def _check_is(value: Any, kind: type, name: str) -> None:
    if type(value) not in ((int, float) if kind is float else (kind,)):
        raise ValueError(f"{name} must be {kind.__name__}, got {reprlib.repr(value)}")
    if kind is str and not is_printable(value):
        raise ValueError(f"{name} must be printable, got {reprlib.repr(value)}")


def _check_keys(value: dict[str, Any], form: Any, name: str) -> None:
    for key in sorted(getattr(form, "__required_keys__", set()) - value.keys()):
        raise ValueError(f"{name} lacks {key!r}")
    for key in sorted(value.keys() - get_type_hints(form).keys()):
        raise ValueError(f"{name} has an unknown {reprlib.repr(key)}")


class BusyError(ValueError):
    """Another process writes to a folder."""


@contextlib.contextmanager
def lock_folder(path: Path, wait: float = 1) -> Iterator[None]:
    """Makes this process the only writer of a folder; makes the folder if missing.

    Waits for up to `wait` seconds, because a launcher takes the lock for a moment to see whether a
    run has begun.

    Raises:
      BusyError: another process writes to the folder.
      ValueError: the folder holds a link.
      OSError: the folder cannot be created or locked.
    """
    path.mkdir(parents=True, exist_ok=True)
    for entry in path.iterdir():
        if entry.is_symlink():  # writing would change a file elsewhere
            raise ValueError(f"{entry} is a link; replace it by a copy of what it names")
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(filelock.FileLock(path / ".lock", timeout=wait))
        except filelock.Timeout:
            reason = f"{path} is being written by another process; wait for its end"
            raise BusyError(reason) from None
        except NotImplementedError as error:
            raise OSError(f"{path} cannot be locked: {error}") from error
        yield


@contextlib.contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Yields a path to write to; its file replaces `path` at the end of the block.

    A link at `path` is replaced, and the file that it names stays as it is.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.unlink(missing_ok=True)  # of a killed process of this number, or a link
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
      ValueError: the file is not regular, or begins with another line.
      OSError: the file cannot be written.
    """
    size = path.stat().st_size if is_file(path) else 0
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
