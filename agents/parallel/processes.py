"""Several processes for one run, joined by `jax.distributed`; the first writes and reports."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils


def join(distributed: Sequence[str] | None) -> None:
    """Waits for the other processes of this job; call it before JAX starts.

    Args:
      distributed: None for a single process; empty if a launcher describes the job; else HOST:PORT
        of the first process, the number of processes, and this process's index from 0.

    Raises:
      ValueError: the other processes are not found.
    """
    if distributed is None:
        return
    if "jax_enable_preemption_service" in jax.config.values:  # it would catch SIGTERM
        jax.config.update("jax_enable_preemption_service", False)
    try:
        job: list[Any] = [*distributed[:1], *map(int, distributed[1:])]
        jax.distributed.initialize(*job)
    except (ValueError, RuntimeError, IndexError) as error:
        raise ValueError(
            f"cannot join the other processes ({str(error).splitlines()[0]}): give --distributed "
            "under a launcher, else --distributed HOST:PORT PROCESSES NUMBER"
        ) from error


def max_over_processes(number: int | None) -> int | None:
    """Returns the maximum over processes, None if all pass None or 0; every process calls it."""
    if jax.process_count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.int32(number or 0)))) or None
