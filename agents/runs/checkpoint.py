"""Checkpoints of the whole training state, a file each that is named by its iteration.

A file holds the state's arrays, a record of plain values, and a digest of both. Each is written
atomically, so a kill leaves the checkpoints before it.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from agents.arrays import SUFFIX, Arrays, read_arrays, to_arrays, write_arrays


def save(folder: Path, iteration: int, state: Any, record: dict[str, Any], *, keep: int) -> None:
    """Saves a pytree of arrays and keys with a record of plain values.

    Only one process may write to a folder. The `keep` newest checkpoints are left, and one of this
    iteration is kept as it is.

    Raises:
      OSError: the file cannot be written.
    """
    folder.mkdir(exist_ok=True)
    for draft in folder.glob(".*"):  # left by a killed process
        draft.unlink()
    path, arrays = _file(folder, iteration), to_arrays(state)
    if not path.exists():
        record = {**record, "iteration": iteration}
        write_arrays(path, arrays, {"record": record, "digest": digest(arrays, record)})
    for old in iterations(folder)[:-keep]:
        _file(folder, old).unlink()


def iterations(folder: Path) -> list[int]:
    """Returns the iterations that have a checkpoint, in order; none if the folder is missing."""
    names = [path.name.removesuffix(SUFFIX) for path in folder.glob(f"*{SUFFIX}")]
    return sorted(int(name) for name in names if name.isdigit())


def load(folder: Path, iteration: int | None = None) -> tuple[Arrays, dict[str, Any]]:
    """Reads the arrays of a checkpoint, the newest if `iteration` is None, and its record.

    A writer may delete a checkpoint meanwhile; the next newest is then read.

    Raises:
      ValueError: there is no such checkpoint, or it is damaged; the message says what to do.
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
        arrays, about = read_arrays(path)
        if about.get("digest") == digest(arrays, about.get("record")):
            return arrays, about["record"]
        problem = "its numbers have changed"
    except FileNotFoundError:
        if iteration is None:
            return load(folder)
        raise
    except ValueError as error:
        problem = str(error)
    others = [other for other in known if other != chosen]
    advice = f"use checkpoint {others[-1]}" if others else "begin again"
    raise ValueError(f"checkpoint {path} is damaged ({problem}); delete it to {advice}")


def digest(arrays: Arrays, record: Any) -> str:
    """Returns the SHA-256 of a record and of names, dtypes, shapes and values."""
    total = hashlib.sha256(json.dumps(record, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        total.update(f"{name} {array.dtype} {array.shape}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _file(folder: Path, iteration: int) -> Path:
    return folder / f"{iteration}{SUFFIX}"
