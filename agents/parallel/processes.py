"""Several processes for one run, joined by `jax.distributed`.

All processes run the same command in a folder that all can read. The first one writes and reports.
"""

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
from jax.experimental import multihost_utils

from agents.command_line import option


@dataclasses.dataclass(frozen=True)
class Job:
    """Options that join processes.

    Attributes:
      distributed: trains together with the other processes of this job. Slurm, Open MPI,
        Kubernetes or a Cloud TPU describe it.
      coordinator: HOST:PORT of the first process. Needed where no launcher describes the job.
      processes: number of processes, with --coordinator.
      process_id: number of this process from 0, with --coordinator.
    """

    distributed: bool = option(False, "devices and hosts")
    coordinator: str | None = option(None, "devices and hosts")
    processes: int | None = option(None, "devices and hosts")
    process_id: int | None = option(None, "devices and hosts")

    def __post_init__(self) -> None:
        """Checks the options.

        Raises:
          ValueError: an option is missing or not allowed.
        """
        given = [self.coordinator, self.processes, self.process_id]
        if given == [None] * 3:
            return
        if self.coordinator is None or self.processes is None or self.process_id is None:
            raise ValueError("coordinator, processes and process_id belong together; give all")
        if not self.coordinator.rpartition(":")[2].isdigit():
            raise ValueError(f"coordinator must be HOST:PORT, got {self.coordinator!r}")
        if not 0 <= self.process_id < self.processes:
            raise ValueError(
                f"process_id must be in [0, {self.processes - 1}], got {self.process_id}"
            )

    def join(self) -> None:
        """Waits for the other processes, if any; call it before JAX starts.

        Raises:
          ValueError: the other processes were not found.
        """
        if not self.distributed and self.coordinator is None:
            return
        jax.config.update("jax_enable_preemption_service", False)  # it would catch SIGTERM
        try:
            jax.distributed.initialize(self.coordinator, self.processes, self.process_id)
        except (ValueError, RuntimeError) as error:
            raise ValueError(
                f"the other processes were not found ({str(error).splitlines()[0]}); without a "
                "launcher, give --coordinator, --processes and --process-id"
            ) from error


def count() -> int:
    """Returns the number of processes."""
    return jax.process_count() if jax.distributed.is_initialized() else 1


def is_first() -> bool:
    """Returns whether this process writes and reports."""
    return count() == 1 or jax.process_index() == 0


def agree(number: int | None) -> int | None:
    """Returns the largest number of any process, None if none has one; all must call it."""
    if count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.int32(number or 0)))) or None


def barrier() -> None:
    """Waits until all processes have called it."""
    agree(None)


def on_first(function: Callable[[], object]) -> None:
    """Calls a function in the first process alone; the others wait until it has returned.

    Raises:
      ValueError: it failed, in the other processes; the first one raises its own error.
    """
    failed = True
    try:
        if is_first():
            function()
        failed = False
    finally:
        failed = agree(failed)
    if failed:
        raise ValueError("the first process has failed; its output says why")
