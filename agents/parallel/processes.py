"""Several processes for one run, joined by `jax.distributed`; the first writes and reports."""

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

    def join(self) -> None:
        """Waits for the other processes, if any; call it before JAX starts.

        Raises:
          ValueError: the options are incomplete, or the other processes are not found.
        """
        given = (self.coordinator, self.processes, self.process_id)
        if not self.distributed and given == (None, None, None):
            return
        if "jax_enable_preemption_service" in jax.config.values:  # it would catch SIGTERM
            jax.config.update("jax_enable_preemption_service", False)
        try:
            jax.distributed.initialize(*given)
        except (ValueError, RuntimeError, IndexError) as error:
            raise ValueError(
                f"cannot join the other processes ({str(error).splitlines()[0]}): give "
                "--distributed under a launcher, else --coordinator HOST:PORT, --processes and "
                "--process-id"
            ) from error


def is_first() -> bool:
    """Returns whether this process writes and reports."""
    return not jax.distributed.is_initialized() or jax.process_index() == 0


def agree(number: int | None) -> int | None:
    """Returns the largest number of any process, None if all have None or 0; all must call it."""
    if not jax.distributed.is_initialized():
        return number
    return int(np.max(multihost_utils.process_allgather(np.int32(number or 0)))) or None


def on_first(function: Callable[[], object]) -> None:
    """Calls a function in the first process; the others wait for it.

    Raises:
      ValueError: the function failed in the first process, which raises its own error.
    """
    failed = True
    try:
        if is_first():
            function()
        failed = False
    finally:
        failed = agree(failed)
    if failed:
        raise ValueError("the first process failed; its output says why")
