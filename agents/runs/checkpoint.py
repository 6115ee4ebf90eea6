"""Checkpoints: the whole state of training, on disk, whole or not at all.

A checkpoint is a flat table of NumPy arrays, named by their place in the state, and a
JSON record with a digest of them. Reading one needs neither the classes that wrote it nor
the device.
"""

import functools
import hashlib
import logging
from pathlib import Path
from typing import Any, Self, TypeVar

import jax
import numpy as np

from agents.arrays import Arrays, from_arrays, to_arrays
from trap_tube_jax._version import __version__

Tree = TypeVar("Tree")


class CheckpointError(ValueError):
    """A checkpoint cannot be used; the message names it and says what to do."""


class Checkpoints:
    """The checkpoints of one run, each named by the iteration after which it was made.

    Close it, or use it as a context manager.
    """

    def __init__(self, folder: Path, *, keep: int | None = None):
        """Opens `folder`.

        Args:
          folder: made if missing, unless it is for reading only.
          keep: how many to keep, the newest, at least 1; None opens it for reading only.

        Raises:
          ValueError: `keep` is below 1.
          CheckpointError: there is no such folder to read.
        """
        if keep is not None and keep < 1:
            raise ValueError(f"keep must be >= 1, got {keep}")
        if keep is None and not folder.is_dir():
            raise CheckpointError(f"{folder} holds no checkpoint")
        self.folder, self._keep = folder, keep
        folder.mkdir(parents=True, exist_ok=True)

    @functools.cached_property
    def _ocp(self) -> Any:
        """Orbax, imported where there is something to read or write: importing it is slow."""
        import orbax.checkpoint as ocp  # noqa: PLC0415

        # It reports every refused file with a stack trace of its own.
        logging.getLogger("absl").setLevel(logging.CRITICAL)
        return ocp

    @functools.cached_property
    def _manager(self) -> Any:
        ocp = self._ocp
        options = ocp.CheckpointManagerOptions(
            max_to_keep=self._keep,
            read_only=self._keep is None,
            create=False,
            cleanup_tmp_directories=self._keep is not None,
            enable_async_checkpointing=False,
            multiprocessing_options=_this_process_alone(ocp),
        )
        return ocp.CheckpointManager(self.folder.absolute(), options=options)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends whatever works in the background."""
        if "_manager" in vars(self):
            self._manager.close()

    @property
    def iterations(self) -> list[int]:
        """The iterations that have a checkpoint, in order."""
        if not any(self.folder.iterdir()):
            return []
        return sorted(self._manager.all_steps(read=True))

    def save(self, iteration: int, state: Any, record: dict[str, Any]) -> None:
        """Saves a pytree of arrays, PRNG keys included; returns once it is on disk.

        Args:
          iteration: its name; nothing happens if that is taken.
          state: the pytree.
          record: plain values to keep with it.
        """
        if iteration in self.iterations:
            return
        arrays = to_arrays(state)
        record = {**record, "iteration": iteration, "digest": digest(arrays)}
        args = self._ocp.args
        items = args.Composite(state=args.StandardSave(arrays), record=args.JsonSave(record))
        self._manager.save(iteration, args=items, force=True)

    def load(self, iteration: int | None = None) -> tuple[Arrays, dict[str, Any]]:
        """The arrays of a checkpoint by name, and its record.

        Args:
          iteration: which one; the newest if absent.

        Raises:
          CheckpointError: there is none, or it is damaged or of another kind.
        """
        known = self.iterations
        if not known:
            raise CheckpointError(f"{self.folder} holds no checkpoint")
        iteration = known[-1] if iteration is None else iteration
        if iteration not in known:
            names = ", ".join(map(str, known))
            raise CheckpointError(
                f"{self.folder} holds no checkpoint {iteration}; allowed: {names}"
            )
        args = self._ocp.args
        items = args.Composite(state=args.StandardRestore(), record=args.JsonRestore())
        try:
            restored = self._manager.restore(iteration, args=items)
            arrays, record = restored["state"], restored["record"]
            intact = digest(arrays) == record["digest"]
        # Which of its many errors Orbax raises depends on the file that is damaged.
        except Exception as error:
            raise self.refuse(iteration, f"cannot be read ({_first_line(error)})") from error
        if not intact:
            raise self.refuse(iteration, "does not hold the numbers that were saved")
        return arrays, record

    def restore(self, template: Tree) -> tuple[Tree, dict[str, Any]]:
        """The state and the record of the newest checkpoint.

        Args:
          template: the structure, as arrays or as `jax.eval_shape` gives it.

        Raises:
          CheckpointError: there is none, or it is damaged or does not fit the template.
        """
        arrays, record = self.load()
        try:
            return from_arrays(arrays, template), record
        except ValueError as error:
            raise self.refuse_misfit(record, error) from error

    def refuse_misfit(self, record: dict[str, Any], error: Exception) -> CheckpointError:
        """The error of a checkpoint that has other arrays than are expected."""
        wrote = record.get("version", "unknown")
        problem = (
            f"does not fit the run's settings or this version ({error}; version {wrote} wrote "
            f"it, this is {__version__})"
        )
        return self.refuse(record["iteration"], problem)

    def refuse(self, iteration: int, problem: str) -> CheckpointError:
        """The error that says what to do about a checkpoint."""
        others = [other for other in self.iterations if other != iteration]
        advice = f"to use checkpoint {max(others)} instead" if others else "to begin again"
        path = self.folder / str(iteration)
        return CheckpointError(
            f"checkpoint {path} {problem}: delete that folder {advice}, or use another run"
        )


def digest(arrays: Arrays) -> str:
    """A SHA-256 over names, types, shapes and values."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        total.update(f"{name} {array.dtype} {array.shape}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _this_process_alone(ocp: Any) -> Any:
    """Orbax waits for no other process: one of them reads and writes."""
    if not jax.distributed.is_initialized():
        return ocp.options.MultiprocessingOptions()
    own = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=f"process{own}"
    )


def _first_line(error: Exception) -> str:
    lines = str(error).splitlines()
    return f"{type(error).__name__}: {lines[0][:120]}" if lines else type(error).__name__
