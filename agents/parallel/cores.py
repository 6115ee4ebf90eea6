"""The cores of this machine, and a CPU that appears as one device a core.

XLA runs most loops of a CPU's program on one core. Where devices share the episodes, each has a
core of its own.
"""

import contextlib
import os

import jax

MOST = 4  # cores that share a run by default; with more, each one's part gets too small


def available_cores() -> list[int]:
    """The numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def become_devices(devices: int | str | None) -> None:
    """Makes a CPU appear as devices, of one core each. Call it before any computation.

    Nothing changes where JAX_NUM_CPU_DEVICES says how many there are, or JAX has begun.

    Args:
      devices: how many are wanted, `all`, or None: up to `MOST`. There are as many as cores at
        most, and one at least.
    """
    if jax.config.values["jax_num_cpu_devices"] >= 0:
        return
    most = len(available_cores())
    wanted = MOST if devices is None else most if devices == "all" else int(devices)
    with contextlib.suppress(RuntimeError):  # too late
        jax.config.update("jax_num_cpu_devices", max(1, min(wanted, most)))
