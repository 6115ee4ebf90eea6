"""Several processes that train together: how they meet, agree and part.

Each process runs the same command and owns some of the devices; `jax.distributed` joins them.
The first process alone reads and writes files and shows anything, the others hear from it.
A single process is the first, and asks nobody.
"""

import dataclasses
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable
from typing import NoReturn, TypeVar

import jax
import numpy as np

from agents.command_line import Flag

Value = TypeVar("Value")


@dataclasses.dataclass(frozen=True)
class Job:
    """How this process finds the others.

    Attributes:
      distributed: trains together with the other processes of this job. Slurm, Open MPI,
        Kubernetes or a Cloud TPU describe it.
      coordinator: HOST:PORT of the first process. Needed where no launcher describes the job.
      processes: number of processes, with --coordinator.
      process_id: number of this process from 0, with --coordinator.
      peer_timeout: seconds after which a silent process counts as lost.
    """

    distributed: Flag = False
    coordinator: str | None = None
    processes: int | None = None
    process_id: int | None = None
    peer_timeout: int = 100

    def __post_init__(self) -> None:
        """Refuses a description that is incomplete or contradicts itself."""
        given = [self.coordinator, self.processes, self.process_id]
        if any(value is None for value in given) and given != [None] * 3:
            raise ValueError(
                "coordinator, processes and process_id belong together; give all, or "
                "--distributed alone where a launcher describes the job"
            )
        if self.coordinator is not None and not self.coordinator.rpartition(":")[2].isdigit():
            raise ValueError(f"coordinator must be HOST:PORT, got {self.coordinator!r}")
        if self.processes is not None and self.processes < 1:
            raise ValueError(f"processes must be >= 1, got {self.processes}")
        if self.process_id is not None and not 0 <= self.process_id < (self.processes or 1):
            raise ValueError(
                f"process_id must lie in [0, {(self.processes or 1) - 1}], got {self.process_id}"
            )
        if self.peer_timeout < 1:
            raise ValueError(f"peer_timeout must be >= 1, got {self.peer_timeout}")

    @property
    def is_alone(self) -> bool:
        """Whether there are no others."""
        return not self.distributed and self.coordinator is None

    def join(self) -> None:
        """Waits for the other processes, if there are any. Call it before any computation.

        Raises:
          ValueError: they cannot be found, or differ in their number of devices.
        """
        if self.is_alone:
            return
        try:
            jax.distributed.initialize(
                self.coordinator,
                self.processes,
                self.process_id,
                heartbeat_timeout_seconds=self.peer_timeout,
            )
        except (ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            advice = "" if self.coordinator else "; give --coordinator, --processes, --process-id"
            raise ValueError(f"the other processes are not found ({reason}){advice}") from error
        if threading.current_thread() is threading.main_thread():
            # JAX catches SIGTERM for a service of its own; before training it has to end us.
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        devices = [device.process_index for device in jax.devices()]
        counts = np.bincount(devices, minlength=jax.process_count())
        if len(set(counts.tolist())) > 1:
            raise ValueError(f"every process must have as many devices, they have {counts}")


def count() -> int:
    """How many processes train together."""
    return jax.process_count() if jax.distributed.is_initialized() else 1


def is_first() -> bool:
    """Whether this is the process that reads, writes and reports."""
    return count() == 1 or jax.process_index() == 0


def from_first(function: Callable[[], Value]) -> Value:
    """What `function()` returns in the first process, which alone calls it; picklable.

    Raises:
      ValueError: it raised there, and this is another process.
      Exception: it raised here, after the others were told.
    """
    if count() == 1:
        return function()
    if not is_first():
        message = _broadcast(b"")
        if not message:
            raise ValueError("the first process has refused; its output says why")
        return pickle.loads(message)
    message = b""
    try:
        value = function()
        message = pickle.dumps(value)
    finally:
        _broadcast(message)
    return value


def agree(number: int | None) -> int | None:
    """The largest number that any process has; None if none has one. All have to call it."""
    if count() == 1:
        return number
    from jax.experimental import multihost_utils  # noqa: PLC0415  slow to import

    largest = int(np.max(multihost_utils.process_allgather(np.int32(number or 0))))
    return largest or None


def leave(code: int) -> NoReturn:
    """Ends this process at once; the others, if there are any, notice and end with an error.

    What it has written is on disk; a checkpoint that it was writing is as if it had not begun.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    # An orderly exit would wait for what compiles in the background, and for the others, who wait
    # for this process.
    os._exit(code)


def _broadcast(message: bytes) -> bytes:
    """The message of the first process."""
    from jax.experimental import multihost_utils  # noqa: PLC0415  slow to import

    size = int(multihost_utils.broadcast_one_to_all(np.int32(len(message))))
    padded = np.zeros(size, np.uint8)
    padded[: len(message)] = np.frombuffer(message, np.uint8)
    return multihost_utils.broadcast_one_to_all(padded).tobytes() if size else b""

import contextlib
nothing = contextlib.nullcontext
def barrier(): pass
