"""The same training over several devices: what each computes, and what they exchange.

A mesh has two axes, `seeds` and `episodes`. Along `seeds` nothing but metrics is exchanged. Along
`episodes` every device holds all parameters and computes what is expensive for its own share
alone: it plays its episodes, computes what the curiosity pays for them, and differentiates its
part of every minibatch. Three things are exchanged:

  1. once per iteration, the episodes without their features (two kilobytes each) and their
     intrinsic rewards, from which every device computes all advantages;
  2. once per gradient step, gradient and metrics, averaged in one reduction;
  3. the outcomes of evaluation.

`jax.shard_map` rather than the compiler's own partitioning, because observations are sorted
to find the distinct ones and loops run as long as the data ask for: within a share both stay
on the device. All devices draw the numbers of one device and keep their part of them, so the
result is that of one device up to the order of float32 sums.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from agents.config import Config

Tree = TypeVar("Tree")

SEEDS, EPISODES = "seeds", "episodes"


@dataclasses.dataclass(frozen=True)
class Shards:
    """The episodes of one seed, divided evenly over the mesh axis `episodes`.

    The methods are for use within `Placement.shard`. With one shard they do nothing at all.

    Attributes:
      count: devices along the axis.
    """

    count: int = 1

    def part(self, tree: Tree) -> Tree:
        """This device's share of the rows of arrays that every device holds whole."""
        if self.count == 1:
            return tree

        def own(x: jax.Array) -> jax.Array:
            size = len(x) // self.count
            return jax.lax.dynamic_slice_in_dim(x, self._index() * size, size)

        return jax.tree.map(own, tree)

    def whole(self, tree: Tree, axis: int = 0) -> Tree:
        """The shares of all devices side by side; the inverse of `part`."""
        if self.count == 1:
            return tree
        return jax.lax.all_gather(tree, EPISODES, axis=axis, tiled=True)

    def mean(self, tree: Tree) -> Tree:
        """The mean over devices of float32 arrays, in one reduction."""
        if self.count == 1:
            return tree
        flat, restore = ravel_pytree(tree)
        return restore(jax.lax.pmean(flat, EPISODES))

    def drawing(self, choose: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
        """`choose(key, outputs)`, drawn as on one device, of which each keeps its own part."""
        if self.count == 1:
            return choose

        def own(key: jax.Array, outputs: Any) -> jax.Array:
            return self.part(choose(key, jax.tree.map(self._spread, outputs)))

        return own

    def _spread(self, x: jax.Array) -> jax.Array:
        """This device's share at its place, zeros at the others'."""
        everyone = jnp.zeros((self.count * len(x), *x.shape[1:]), x.dtype)
        return jax.lax.dynamic_update_slice_in_dim(everyone, x, self._index() * len(x), axis=0)

    def _index(self) -> jax.Array | int:
        return jax.lax.axis_index(EPISODES) if self.count > 1 else 0


ALONE = Shards()


@dataclasses.dataclass(frozen=True)
class Placement:
    """Where a run computes.

    Attributes:
      mesh: the devices, seeds by episodes; None for the one default device.
    """

    mesh: Mesh | None = None

    @classmethod
    def of(cls, devices: int | str | None, config: Config, seeds: int) -> Self:
        """The placement of a run on a number of devices.

        Args:
          devices: how many, over all processes, or `all`. If absent: with several processes
            all, on a CPU as many as share the work evenly, else one.
          config: the settings.
          seeds: seeds trained side by side.

        Raises:
          ValueError: there are not as many, or they cannot share the work evenly.
        """
        processes, available = jax.process_count(), len(jax.devices())
        allowed = [n for n in range(1, available + 1) if _is_even(n, processes, config, seeds)]
        if devices is None and processes == 1:
            devices = max(allowed) if jax.default_backend() == "cpu" else 1
        wanted = available if devices in ("all", None) else devices
        if wanted not in allowed:
            raise ValueError(
                f"{wanted} devices cannot share minibatch={config.minibatch_size} and seeds={seeds} "
                f"evenly; {available} {jax.default_backend()} devices of {processes} process(es) "
                f"are there; allowed: {', '.join(map(str, allowed)) or 'none'}"
            )
        if wanted == processes == 1:
            return cls()
        chosen = [
            [device for device in jax.devices() if device.process_index == process]
            for process in range(processes)
        ]
        grid = np.array([own[: wanted // processes] for own in chosen])
        return cls(Mesh(grid.reshape(math.gcd(wanted, seeds), -1), (SEEDS, EPISODES)))

    @property
    def devices(self) -> int:
        """How many there are."""
        return 1 if self.mesh is None else self.mesh.size

    @property
    def episodes(self) -> Shards:
        """How the episodes of a seed are divided."""
        return ALONE if self.mesh is None else Shards(self.mesh.shape[EPISODES])

    @property
    def sharding(self) -> NamedSharding | None:
        """How the states of seeds [S, ...] lie on the devices; None for the one default device."""
        return None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec(SEEDS))

    def shard(self, advance: Callable[..., Any]) -> Callable[..., Any]:
        """Divides (states [S, ...], bool[S]) -> (states [S, ...], metrics [S]) over the mesh."""
        if self.mesh is None:
            return advance

        seed_shards = self.mesh.shape[SEEDS]

        def own(*inputs: Any) -> tuple[Any, Any]:
            state, metrics = advance(*inputs)
            if seed_shards > 1:
                metrics = jax.lax.all_gather(metrics, SEEDS, tiled=True)
            return state, metrics

        outputs = (PartitionSpec(SEEDS), PartitionSpec())
        return _map(own, self.mesh, PartitionSpec(SEEDS), outputs)

    def put(self, state: Tree) -> Tree:
        """A state [S, ...] from the default device to the devices that train with it."""
        if self.mesh is None:
            return state
        numbers = jax.tree.map(lambda x: np.asarray(key_data(x)), state)

        def whole(numbers: Any) -> Any:
            return jax.tree.map(
                lambda x, like: jax.random.wrap_key_data(x) if is_key(like) else x, numbers, state
            )

        # NumPy arrays, unlike those of a device, may go to devices of other processes.
        return jax.jit(whole, out_shardings=self.sharding)(numbers)

    def local(self, tree: Tree) -> Tree:
        """The whole arrays, wherever their parts lie, on one device of this process.

        Every process has to call it.
        """
        if self.mesh is None:
            return tree
        whole = NamedSharding(self.mesh, PartitionSpec())
        everywhere = jax.jit(_same, out_shardings=whole)(tree)
        return jax.tree.map(lambda x: x.addressable_data(0), everywhere)

    def __str__(self) -> str:
        """The devices, for people."""
        kind = jax.devices()[0].platform
        if self.mesh is None:
            return kind
        processes = jax.process_count()
        within = f" of {processes} processes" if processes > 1 else ""
        return f"{self.mesh.size} {kind} devices{within}"


def _map(function: Callable[..., Any], mesh: Mesh, inputs: Any, outputs: Any) -> Callable[..., Any]:
    # Loops carry arrays that are the same everywhere into ones that are not; the check of
    # varying axes would want every such start marked.
    return jax.shard_map(function, mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False)


def _same(tree: Any) -> Any:
    return tree


def is_key(x: Any) -> bool:
    """Whether an array, or its shape, is of typed PRNG keys."""
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def key_data(x: jax.Array) -> jax.Array:
    """The numbers of keys; other arrays as they are."""
    return jax.random.key_data(x) if is_key(x) else x


def _is_even(devices: int, processes: int, config: Config, seeds: int) -> bool:
    """Whether devices can share the seeds, and those of one seed its minibatches."""
    per_process, rest = divmod(devices, processes)
    shards = devices // math.gcd(devices, seeds)
    enough = per_process <= jax.local_device_count()
    return rest == 0 and enough and config.minibatch_size % shards == 0
