"""Several devices for one run: a mesh of seeds × episodes, as README.md describes it.

States [S, ...] are split along `seeds` and replicated along `episodes`.

    learner = make_train(config, axis=placement.axis)
    iterate = jax.jit(placement.shard(jax.vmap(learner.iterate)), donate_argnums=0)
    states, metrics = iterate(placement.put(states))
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable
from typing import Any, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from agents.config import Config

Tree = TypeVar("Tree")

SEEDS, EPISODES = "seeds", "episodes"  # axes of the mesh


def become_devices(devices: int | None) -> None:
    """Splits the CPU into devices, unless JAX_NUM_CPU_DEVICES does; call it before JAX starts."""
    if devices is not None and devices > 1 and jax.config.values["jax_num_cpu_devices"] < 0:
        with contextlib.suppress(RuntimeError):  # JAX has started: `Placement.of` says what it has
            jax.config.update("jax_num_cpu_devices", devices)


@dataclasses.dataclass(frozen=True)
class EpisodeAxis:
    """The `size` devices that share a seed's episodes; on one every method is the identity."""

    size: int = 1

    def mean(self, tree: Tree) -> Tree:
        """Averages floats over the devices; integers are the same on all and stay."""
        if self.size == 1:
            return tree
        is_float = lambda x: jnp.issubdtype(x.dtype, jnp.floating)  # noqa: E731
        return jax.tree.map(lambda x: jax.lax.pmean(x, EPISODES) if is_float(x) else x, tree)

    def part(self, x: jax.Array) -> jax.Array:
        """Returns this device's rows i, i + size, i + 2 size, ... of `x` [B, ...]."""
        return x if self.size == 1 else x.reshape(-1, self.size)[:, jax.lax.axis_index(EPISODES)]

    def gather(self, x: jax.Array) -> jax.Array:
        """Returns the rows [B] of all devices; inverts `part`."""
        return x if self.size == 1 else jax.lax.all_gather(x, EPISODES, axis=1).reshape(-1)

    def own_key(self, key: jax.Array) -> jax.Array:
        """Derives this device's PRNG key."""
        return key if self.size == 1 else jax.random.fold_in(key, jax.lax.axis_index(EPISODES))


ONE_DEVICE = EpisodeAxis()


@dataclasses.dataclass(frozen=True)
class Placement:
    """The devices of a run: a mesh, seeds × episodes; None for the default device alone."""

    mesh: Mesh | None = None

    @classmethod
    def of(cls, devices: int | None, config: Config, seeds: int) -> Self:
        """Places seeds on a number of devices; None is one, or all of several processes.

        Raises:
          ValueError: the devices do not exist, or do not divide the minibatches.
        """
        processes, available = jax.process_count(), jax.device_count()
        counts = range(1, available + 1) if processes == 1 else [available]
        allowed = [n for n in counts if config.minibatch_size % (n // math.gcd(n, seeds)) == 0]
        devices = counts[0] if devices is None else devices
        if devices not in allowed:
            raise ValueError(
                f"{devices} of {available} {jax.default_backend()} devices in {processes} "
                f"process(es) cannot share {seeds} seed(s) with minibatch_size="
                f"{config.minibatch_size}; allowed: {', '.join(map(str, allowed)) or 'none'}"
            )
        if devices == 1:
            return cls()
        grid = np.array(jax.devices()[:devices]).reshape(math.gcd(devices, seeds), -1)
        return cls(Mesh(grid, (SEEDS, EPISODES)))

    @property
    def axis(self) -> EpisodeAxis:
        """The devices that share a seed."""
        return EpisodeAxis(1 if self.mesh is None else self.mesh.shape[EPISODES])

    def shard(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Maps a function of arrays [S, ...] to arrays [S, ...] over the devices."""
        if self.mesh is None:
            return function
        rows = PartitionSpec(SEEDS)
        # Loops turn replicated carries into ones that vary, which check_vma refuses.
        return jax.shard_map(
            function, mesh=self.mesh, in_specs=rows, out_specs=rows, check_vma=False
        )

    def put(self, states: Tree) -> Tree:
        """Moves arrays [S, ...] from the default device, or NumPy, to the devices."""
        if self.mesh is None:
            return states
        rows = NamedSharding(self.mesh, PartitionSpec(SEEDS))
        # Unlike `device_put`, takes keys to the devices of several processes.
        place = jax.make_array_from_callback
        return jax.tree.map(lambda x: place(x.shape, rows, lambda index: x[index]), states)

    def local(self, states: Tree) -> Tree:
        """Copies arrays [S, ...] to one device of this process; all processes must call it."""
        if self.mesh is None:
            return states
        # `device_put` does not take keys of several processes.
        replicate = jax.jit(_same, out_shardings=NamedSharding(self.mesh, PartitionSpec()))
        return jax.tree.map(lambda x: x.addressable_data(0), replicate(states))

    def __str__(self) -> str:
        """Names the devices, as in "4 gpu devices of 2 process(es)"."""
        platform = jax.default_backend()
        if self.mesh is None:
            return platform
        return f"{self.mesh.size} {platform} devices of {jax.process_count()} process(es)"


def _same(tree: Tree) -> Tree:
    return tree
