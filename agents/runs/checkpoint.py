"""Checkpoints of the whole training state, by Orbax.

A checkpoint is a flat table of NumPy arrays and a JSON record. Orbax writes it atomically and in
the foreground. The record holds a digest of the arrays, because Orbax returns other numbers
without an error where a byte of its files has changed.
"""

import hashlib
import logging
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
    """The checkpoints of one run, each named by its iteration. A context manager."""

    def __init__(self, folder: Path, *, keep: int | None = None):
        """Opens a folder: to keep the `keep` newest checkpoints, or for reading only if None.

        Raises:
          CheckpointError: a folder to read is missing.
        """
        self.folder = folder
        if keep is None and not folder.is_dir():
            raise CheckpointError(f"{folder} holds no checkpoint")
        if keep is not None:
            folder.mkdir(parents=True, exist_ok=True)  # Orbax refuses to for one of many processes
        self._manager = ocp.CheckpointManager(
            folder.absolute(),
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep,
                read_only=keep is None,
                create=False,
                cleanup_tmp_directories=keep is not None,
                enable_async_checkpointing=False,
                multiprocessing_options=_this_process_alone(),
            ),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._manager.close()

    @property
    def iterations(self) -> list[int]:
        """The iterations that have a checkpoint, in order."""
        return sorted(self._manager.all_steps(read=True))

    def save(self, iteration: int, state: Any, record: dict[str, Any]) -> None:
        """Saves a pytree of arrays and keys with a record of plain values.

        Returns once both are on disk. A checkpoint of this iteration is kept as it is.

        Raises:
          OSError: the checkpoint cannot be written.
        """
        if iteration in self.iterations:
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

    def load(self, iteration: int | None = None) -> tuple[Arrays, dict[str, Any]]:
        """Reads the arrays of a checkpoint and its record.

        A writer may delete old checkpoints meanwhile: where the newest is asked for and vanishes,
        the next newest is read.

        Args:
          iteration: the checkpoint; the newest if None.

        Raises:
          CheckpointError: there is none, or it is damaged.
        """
        known = self.iterations
        if not known:
            raise CheckpointError(f"{self.folder} holds no checkpoint")
        chosen = known[-1] if iteration is None else iteration
        if chosen not in known:
            allowed = ", ".join(map(str, known))
            raise CheckpointError(f"{self.folder} holds no checkpoint {chosen}; allowed: {allowed}")
        items = ocp.args.Composite(state=ocp.args.StandardRestore(), record=ocp.args.JsonRestore())
        try:
            restored = self._manager.restore(chosen, args=items)
            arrays, record = restored["state"], restored["record"]
            if digest(arrays) == record["digest"]:
                return arrays, record
            problem = "its numbers have changed"
        except Exception as error:  # depends on the file that is damaged
            problem = _first_line(error)
        if iteration is None and chosen not in (now := self.iterations) and now:
            return self.load()
        others = [other for other in known if other != chosen]
        advice = f"use checkpoint {others[-1]}" if others else "begin again"
        raise CheckpointError(
            f"checkpoint {self.folder / str(chosen)} is damaged ({problem}); delete it to {advice}"
        )


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
