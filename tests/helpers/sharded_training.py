"""Trains on two simulated devices and on one; prints as JSON what a test compares.

Runs as a process of its own, since the number of devices is fixed once JAX has started.
"""

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import trap_tube_jax as tt
from agents.arrays import key_data, to_arrays
from agents.parallel.devices import EPISODES, ONE_DEVICE, Placement, split_cpu
from agents.ppo.learner import make_learner
from helpers.small_runs import small_config

SIZES = {"episodes_per_iteration": 16, "minibatch_size": 8, "epochs": 2, "replay_capacity": 5}
CONFIG = small_config(**SIZES, replay_fractions=(0.25, 0.25))


def small_learner(axis=ONE_DEVICE):
    """A learner on a board that random actions solve soon."""
    base = tt.State.from_ascii(["TA.F........", *["." * 12] * 11])
    return make_learner(CONFIG, tt.Environment(base=base, max_steps=6), axis)


def train(iterations):
    """Trains on two devices; returns the final state where it is, all metrics and the placement."""
    placement = Placement.of(2, CONFIG)
    learner = small_learner(placement.axis)
    state = placement.put(jax.jit(learner.init)(jax.random.key(0)))
    rows = []
    iterate = jax.jit(placement.shard(learner.iterate), donate_argnums=0)
    for _ in range(iterations):
        state, metrics = iterate(state)
        rows.append(to_arrays(placement.local(metrics)))
    return state, rows, placement


def train_seeds():
    """Trains two seeds for an iteration, one on each device by JAX alone, then exchanges them.

    This is the program of agents/parallel/README.md. Returns arrays [2, ...] of the first and of
    the second time, in the same order of seeds, and the number of devices.
    """
    learner = small_learner()
    mesh = jax.make_mesh((2,), ("seeds",), axis_types=(AxisType.Auto,))
    init = jax.jit(jax.vmap(learner.init))
    iterate = jax.jit(jax.vmap(learner.iterate), donate_argnums=0)

    def train(keys):
        keys = jax.device_put(keys, NamedSharding(mesh, PartitionSpec("seeds")))
        return iterate(init(keys))[0]

    keys = jax.random.split(jax.random.key(0), 2)
    first = train(keys)
    second = train(keys[::-1])
    devices = len(first.iteration.devices())
    second = {name: x[::-1] for name, x in to_arrays(second).items()}
    return to_arrays(first), second, devices


def unequal_copies(state):
    """Names the arrays of which the two devices hold different numbers."""
    shards = [
        to_arrays(jax.tree.map(lambda x, i=i: key_data(x).addressable_shards[i].data, state))
        for i in range(2)
    ]
    return [name for name, x in shards[0].items() if not np.array_equal(x, shards[1][name])]


def gradient_gap():
    """Returns the largest relative difference between the gradients of a batch and its halves."""
    learner = small_learner()
    state = jax.jit(learner.init)(jax.random.key(1))

    @jax.jit
    def make_batch(state):
        keys = jax.random.split(jax.random.key(2), CONFIG.episodes_per_iteration)
        trajectory = learner.play(state.params, keys, jax.random.key(3))
        reward, _ = learner.intrinsic_reward(state, trajectory)
        return learner.make_batch(state, trajectory, reward)[0]

    placement = Placement.of(2, CONFIG)
    batch = make_batch(state)
    assert placement.mesh is not None

    def gradient(params, batch):
        return placement.axis.mean(jax.grad(learner.loss, has_aux=True)(params, batch)[0])

    halves: Any = jax.tree.map(lambda _: PartitionSpec(EPISODES), batch)
    whole = PartitionSpec()
    shared = jax.shard_map(
        gradient,
        mesh=placement.mesh,
        in_specs=(whole, halves),
        out_specs=whole,
        check_vma=False,
    )
    expected = to_arrays(jax.jit(jax.grad(learner.loss, has_aux=True))(state.params, batch)[0])
    found = to_arrays(jax.jit(shared)(state.params, batch))
    return max(
        float(np.max(np.abs(found[name] - x)) / max(np.max(np.abs(x)), 1e-6))
        for name, x in expected.items()
    )


def shared_rows():
    """Rows that two devices took and gave back, and how many keys they act with."""
    placement = Placement.of(2, CONFIG)
    axis = placement.axis

    def both(rows, key):
        device_keys = jax.random.key_data(axis.device_key(key))[-1:]
        return axis.gather(axis.part(rows)), axis.gather(device_keys)

    given = placement.put((jnp.arange(6), jax.random.key(0)))
    rows, words = placement.local(jax.jit(placement.shard(both))(*given))
    return rows.tolist(), len(set(words.tolist()))


def shape(x):
    return str(x.dtype), x.shape


def main():
    split_cpu(2)
    shared, rows, placement = train(3)
    state = placement.local(shared)
    learner = small_learner()
    alone, metrics = jax.eval_shape(
        learner.iterate, jax.eval_shape(learner.init, jax.random.key(0))
    )
    first, second, seed_devices = train_seeds()
    steps = sum(row["episode_length"] for row in rows) * CONFIG.episodes_per_iteration
    report = {
        "unequal_copies": unequal_copies(shared),
        "iteration": int(state.iteration),
        "transitions": int(state.transitions),
        "steps_played": round(float(steps)),
        "gradient_gap": gradient_gap(),
        "shared_rows": shared_rows(),
        "seed_devices": seed_devices,
        "seeds_gap": max(
            float(np.max(np.abs(np.float64(first[name]) - x))) for name, x in second.items()
        ),
        "same_shapes": jax.tree.map(shape, state) == jax.tree.map(shape, alone),
        "same_metrics": set(rows[0]) == set(metrics),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
