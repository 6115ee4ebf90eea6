"""Checkpoints of the whole training state, in files named by their iteration.

A file holds the state's arrays and a record of plain values. Files are written atomically, so a
killed process leaves earlier checkpoints intact.
"""

import re
from pathlib import Path
from typing import Any

from agents.arrays import SUFFIX, Arrays, read_arrays, to_arrays, write_arrays

KEPT = 3  # the newest checkpoints
CANONICAL = re.compile("0|[1-9][0-9]*")  # names of files; others are somebody else's


def save(folder: Path, iteration: int, state: Any, record: dict[str, Any]) -> None:
    """Saves a pytree of arrays and keys with a record of plain values; leaves the `KEPT` newest.

    Only one process may write to a folder.

    Raises:
      OSError: the file cannot be written.
    """
    folder.mkdir(exist_ok=True)
    for draft in folder.glob(f".*{SUFFIX}.*"):  # left by a killed process
        draft.unlink()
    record = {**record, "iteration": iteration}
    write_arrays(_file(folder, iteration), to_arrays(state), record)
    for old in iterations(folder)[:-KEPT]:
        _file(folder, old).unlink()


def iterations(folder: Path) -> list[int]:
    """Returns the iterations that have a checkpoint, in order; none if the folder is missing."""
    names = [path.name.removesuffix(SUFFIX) for path in folder.glob(f"*{SUFFIX}")]
    return sorted(int(name) for name in names if CANONICAL.fullmatch(name))


def load(folder: Path, iteration: int | None = None) -> tuple[Arrays, dict[str, Any]]:
    """Reads the arrays of a checkpoint, the newest if `iteration` is None, and its record.

    Raises:
      ValueError: there is no such checkpoint, or it is damaged.
      OSError: the file cannot be read.
    """
    known = iterations(folder)
    if not known:
        raise ValueError(f"{folder} holds no checkpoint")
    chosen = known[-1] if iteration is None else iteration
    if chosen not in known:
        allowed = ", ".join(map(str, known))
        raise ValueError(f"{folder} holds no checkpoint {chosen}; allowed: {allowed}")
    path = _file(folder, chosen)
    try:
        return read_arrays(path)
    except ValueError as error:
        raise ValueError(f"{error}; delete it to use the checkpoint before it") from error


def _file(folder: Path, iteration: int) -> Path:
    return folder / f"{iteration}{SUFFIX}"
