"""Checkpoints of the whole training state, by Orbax.

A checkpoint is a folder named by its iteration. It holds a flat table of NumPy arrays and a JSON
record. Orbax writes it atomically and in the foreground. The record has a digest of the arrays,
because Orbax returns other numbers without an error where a byte of its files has changed.
"""

import hashlib
import logging
import shutil
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from agents.arrays import Arrays, to_arrays

logging.getLogger("absl").setLevel(logging.CRITICAL)  # a stack trace for every refused file


def save(folder: Path, iteration: int, state: Any, record: dict[str, Any], *, keep: int) -> None:
    """Saves a pytree of arrays and keys with a record of plain values.

    Returns once both are on disk, and the `keep` newest checkpoints alone are left. A checkpoint
    of this iteration is kept as it is. Whatever prevents writing raises OSError.
    """
    folder.mkdir(exist_ok=True)
    if iteration in iterations(folder):
        return
    arrays = to_arrays(state)
    record = {**record, "iteration": iteration, "digest": digest(arrays)}
    items = ocp.args.Composite(
        state=ocp.args.StandardSave(arrays), record=ocp.args.JsonSave(record)
    )
    try:
        with _manager(folder, keep) as manager:
            manager.save(iteration, args=items, force=True)
    except Exception as error:  # Orbax passes on what its many back ends raise
        raise OSError(f"cannot write checkpoint {iteration}: {_first_line(error)}") from error


def iterations(folder: Path) -> list[int]:
    """Returns the iterations that have a checkpoint, in order; none if the folder is missing."""
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return sorted(int(name) for name in names if name.isdigit())  # drafts have other names


def load(folder: Path, iteration: int | None = None) -> tuple[Arrays, dict[str, Any]]:
    """Reads the arrays of a checkpoint, the newest if `iteration` is None, and its record.

    A writer may delete a checkpoint meanwhile; the next newest is then read. A ValueError says what
    to do if there is none, or it is damaged.
    """
    known = iterations(folder)
    if not known:
        raise ValueError(f"{folder} holds no checkpoint")
    chosen = known[-1] if iteration is None else iteration
    if chosen not in known:
        allowed = ", ".join(map(str, known))
        raise ValueError(f"{folder} holds no checkpoint {chosen}; allowed: {allowed}")
    items = ocp.args.Composite(state=ocp.args.StandardRestore(), record=ocp.args.JsonRestore())
    try:
        with tempfile.TemporaryDirectory() as copy:  # which no writer deletes
            shutil.copytree(folder / str(chosen), Path(copy, str(chosen)))
            with _manager(Path(copy)) as manager:
                restored = manager.restore(chosen, args=items)
        arrays, record = restored["state"], restored["record"]
        if digest(arrays) == record["digest"]:
            return arrays, record
        problem = "its numbers have changed"
    except Exception as error:  # depends on the file that is damaged
        problem = _first_line(error)
    if iteration is None and iterations(folder)[-1:] != [chosen]:
        return load(folder)
    others = [other for other in known if other != chosen]
    advice = f"use checkpoint {others[-1]}" if others else "begin again"
    raise ValueError(
        f"checkpoint {folder / str(chosen)} is damaged ({problem}); delete it to {advice}"
    )


def digest(arrays: Arrays) -> str:
    """Returns the SHA-256 of names, dtypes, shapes and values."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        total.update(f"{name} {array.dtype} {array.shape}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _manager(folder: Path, keep: int | None = None) -> ocp.CheckpointManager:
    """Opens a folder of checkpoints for this process, which waits for no other of its job."""
    alone = ocp.options.MultiprocessingOptions()
    if jax.process_count() > 1:
        own = jax.process_index()
        alone = ocp.options.MultiprocessingOptions(
            primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
        )
    options = ocp.CheckpointManagerOptions(
        max_to_keep=keep,
        create=False,
        cleanup_tmp_directories=True,
        enable_async_checkpointing=False,
        multiprocessing_options=alone,
    )
    return ocp.CheckpointManager(folder.absolute(), options=options)


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:120]}"
