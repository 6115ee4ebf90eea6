"""Checkpoints of the whole training state, by Orbax.

A checkpoint is a flat table of NumPy arrays and a JSON record. Orbax writes it atomically and in
the foreground. The record holds a digest of the arrays, because Orbax returns other numbers
without an error where a byte of its files has changed.
"""

import hashlib
import logging
import shutil
import tempfile
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
import orbax.checkpoint as ocp

from agents.arrays import Arrays, to_arrays

logging.getLogger("absl").setLevel(logging.CRITICAL)  # a stack trace for every refused file


class CheckpointError(ValueError):
    """A checkpoint cannot be read; the message names it and says what to do."""


class Checkpoints:
    """Writes the checkpoints of one run, each named by its iteration. A context manager."""

    def __init__(self, folder: Path, *, keep: int):
        """Makes the folder if missing; the `keep` newest checkpoints stay in it."""
        folder.mkdir(parents=True, exist_ok=True)  # Orbax refuses to for one of many processes
        self._folder = folder
        self._manager = ocp.CheckpointManager(
            folder.absolute(),
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep,
                create=False,
                cleanup_tmp_directories=True,
                enable_async_checkpointing=False,
                multiprocessing_options=_this_process_alone(),
            ),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._manager.close()

    def save(self, iteration: int, state: Any, record: dict[str, Any]) -> None:
        """Saves a pytree of arrays and keys with a record of plain values.

        Returns once both are on disk. A checkpoint of this iteration is kept as it is.

        Raises:
          OSError: the checkpoint cannot be written.
        """
        if iteration in iterations(self._folder):
            return
        arrays = to_arrays(state)
        record = {**record, "iteration": iteration, "digest": digest(arrays)}
        items = ocp.args.Composite(
            state=ocp.args.StandardSave(arrays), record=ocp.args.JsonSave(record)
        )
        try:
            self._manager.save(iteration, args=items, force=True)
        except Exception as error:  # Orbax passes on what its many back ends raise
            raise OSError(f"cannot write checkpoint {iteration}: {_first_line(error)}") from error


def iterations(folder: Path) -> list[int]:
    """Returns the iterations that have a checkpoint, in order; none if the folder is missing."""
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return sorted(int(name) for name in names if name.isdigit())  # drafts have other names


def load(folder: Path, iteration: int | None = None) -> tuple[Arrays, dict[str, Any]]:
    """Reads the arrays of a checkpoint, the newest if `iteration` is None, and its record.

    A writer may delete a checkpoint meanwhile; the next newest is then read.

    Raises:
      CheckpointError: there is none, or it is damaged.
    """
    known = iterations(folder)
    if not known:
        raise CheckpointError(f"{folder} holds no checkpoint")
    chosen = known[-1] if iteration is None else iteration
    if chosen not in known:
        allowed = ", ".join(map(str, known))
        raise CheckpointError(f"{folder} holds no checkpoint {chosen}; allowed: {allowed}")
    try:
        with tempfile.TemporaryDirectory() as copy:  # which no writer deletes
            shutil.copytree(folder / str(chosen), copy, dirs_exist_ok=True)
            arrays, record = _restore(Path(copy))
        if digest(arrays) == record["digest"]:
            return arrays, record
        problem = "its numbers have changed"
    except Exception as error:  # depends on the file that is damaged
        problem = _first_line(error)
    if iteration is None and iterations(folder)[-1:] != [chosen]:
        return load(folder)
    others = [other for other in known if other != chosen]
    advice = f"use checkpoint {others[-1]}" if others else "begin again"
    raise CheckpointError(
        f"checkpoint {folder / str(chosen)} is damaged ({problem}); delete it to {advice}"
    )


def _restore(path: Path) -> tuple[Arrays, dict[str, Any]]:
    items = ocp.args.Composite(state=ocp.args.StandardRestore(), record=ocp.args.JsonRestore())
    options = _this_process_alone()
    handler = ocp.CompositeCheckpointHandler(
        state=ocp.StandardCheckpointHandler(multiprocessing_options=options),
        record=ocp.JsonCheckpointHandler(multiprocessing_options=options),
    )
    with ocp.Checkpointer(handler, multiprocessing_options=options) as checkpointer:
        restored = checkpointer.restore(path, args=items)
    return restored["state"], restored["record"]


def digest(arrays: Arrays) -> str:
    """Returns the SHA-256 of names, dtypes, shapes and values."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        total.update(f"{name} {array.dtype} {array.shape}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _this_process_alone() -> ocp.options.MultiprocessingOptions:
    """Tells Orbax to wait for no other process: one of them reads and writes."""
    if not jax.distributed.is_initialized():
        return ocp.options.MultiprocessingOptions()
    own = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
    )


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:120]}"
