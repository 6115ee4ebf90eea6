"""Several devices for one run, which share the episodes of every iteration; see README.md.

placement = Placement.of(2, config)
learner = make_learner(config, axis=placement.axis)
iterate = jax.jit(placement.shard(learner.iterate), donate_argnums=0)
state, metrics = iterate(placement.put(state))
"""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any, Self, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from agents.config import Config

Tree = TypeVar("Tree")

EPISODES = "episodes"  # the axis of the mesh


def split_cpu(devices: int | None) -> None:
    """Splits the CPU into devices, unless JAX_NUM_CPU_DEVICES does; call it before JAX starts."""
    if devices is not None and devices > 1 and jax.config.values["jax_num_cpu_devices"] < 0:
        with contextlib.suppress(RuntimeError):  # JAX has started: `Placement.of` says what it has
            jax.config.update("jax_num_cpu_devices", devices)


@dataclasses.dataclass(frozen=True)
class EpisodeAxis:
    """The `size` devices that share the episodes; on one every method is the identity."""

    size: int = 1

    def mean(self, tree: Tree) -> Tree:
        """Averages floats over the devices."""
        return tree if self.size == 1 else jax.lax.pmean(tree, EPISODES)

    def part(self, x: jax.Array) -> jax.Array:
        """Returns this device's rows i, i + size, i + 2 size, ... of `x` [B, ...]."""
        return x if self.size == 1 else x.reshape(-1, self.size)[:, jax.lax.axis_index(EPISODES)]

    def gather(self, x: jax.Array) -> jax.Array:
        """Returns the rows [B] of all devices; inverts `part`."""
        return x if self.size == 1 else jax.lax.all_gather(x, EPISODES, axis=1).reshape(-1)

    def device_key(self, key: jax.Array) -> jax.Array:
        """Derives this device's PRNG key."""
        return key if self.size == 1 else jax.random.fold_in(key, jax.lax.axis_index(EPISODES))


ONE_DEVICE = EpisodeAxis()


@dataclasses.dataclass(frozen=True)
class Placement:
    """The devices of a run: a mesh along `EPISODES`, or None for only the default device."""

    mesh: Mesh | None = None

    @classmethod
    def of(cls, devices: int | None, config: Config) -> Self:
        """Chooses the devices; None means one device, or all devices of a job of several processes.

        Raises:
          ValueError: the devices do not exist, or do not divide the minibatches.
        """
        processes = jax.process_count()
        available = jax.device_count()
        counts = range(1, available + 1) if processes == 1 else [available]
        allowed = [n for n in counts if config.minibatch_size % n == 0]
        devices = counts[0] if devices is None else devices
        if devices not in allowed:
            raise ValueError(
                f"{devices} of {available} {jax.default_backend()} devices in {processes} "
                f"process(es) cannot share minibatch_size={config.minibatch_size}; allowed: "
                f"{', '.join(map(str, allowed)) or 'none'}"
            )
        if devices == 1:
            return cls()
        return cls(Mesh(np.array(jax.devices()[:devices]), (EPISODES,)))

    @property
    def axis(self) -> EpisodeAxis:
        """The devices that share the episodes."""
        return EpisodeAxis(1 if self.mesh is None else self.mesh.size)

    def shard(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Runs a function on every device; arguments and results are the same on all."""
        if self.mesh is None:
            return function
        same = PartitionSpec()
        # Loops turn replicated carries into ones that vary, which check_vma refuses.
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=same, out_specs=same, check_vma=False
        )

    def put(self, tree: Tree) -> Tree:
        """Copies arrays from the default device, or NumPy, to all devices."""
        if self.mesh is None:
            return tree
        same = NamedSharding(self.mesh, PartitionSpec())
        # Unlike `device_put`, takes keys to the devices of several processes.
        make = jax.make_array_from_callback
        return jax.tree.map(lambda x: make(x.shape, same, lambda index: x[index]), tree)

    def local(self, tree: Tree) -> Tree:
        """Returns one device's copy of arrays that are on all."""
        return tree if self.mesh is None else jax.tree.map(lambda x: x.addressable_data(0), tree)

    def __str__(self) -> str:
        """Names the devices, as in "4 gpu devices of 2 process(es)"."""
        platform = jax.default_backend()
        if self.mesh is None:
            return platform
        return f"{self.mesh.size} {platform} devices of {jax.process_count()} process(es)"
