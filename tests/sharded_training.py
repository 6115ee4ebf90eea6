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
from agents.parallel.devices import EPISODES, ONE_DEVICE, Placement, become_devices
from agents.ppo.learner import make_train
from small_runs import small_config

SIZES = {"episodes_per_iteration": 16, "minibatch_size": 8, "epochs": 2, "replay_capacity": 5}
CONFIG = small_config(**SIZES, replay_fractions=(0.25, 0.25))


def make_learner(axis=ONE_DEVICE):
    """A learner on a board that random actions solve soon."""
    base = tt.State.from_ascii(["TA.F........", *["." * 12] * 11])
    return make_train(CONFIG, tt.Environment(base=base, max_steps=6), axis)


def train(devices, iterations):
    """Returns the final state where it is, all metrics, and the placement."""
    placement = Placement.of(devices, CONFIG)
    learner = make_learner(placement.axis)
    state, rows = placement.put(learner.init(jax.random.key(0))), []
    iterate = jax.jit(placement.shard(learner.iterate), donate_argnums=0)
    for _ in range(iterations):
        state, metrics = iterate(state)
        rows.append(to_arrays(placement.local(metrics)))
    return state, rows, placement


def train_seeds(devices):
    """Trains two seeds for an iteration, spread over devices by JAX alone; returns arrays [2, ...].

    This is the program of agents/parallel/README.md.
    """
    learner = make_learner()
    mesh = jax.make_mesh(
        (devices,), ("seeds",), axis_types=(AxisType.Auto,), devices=jax.devices()[:devices]
    )
    keys = jax.random.split(jax.random.key(0), 2)
    keys = jax.device_put(keys, NamedSharding(mesh, PartitionSpec("seeds")))
    states = jax.jit(jax.vmap(learner.init))(keys)
    states, _ = jax.jit(jax.vmap(learner.iterate), donate_argnums=0)(states)
    return to_arrays(states), len(states.iteration.devices())


def unequal_copies(state):
    """Names the arrays of which the two devices hold different numbers."""
    shards = [
        to_arrays(jax.tree.map(lambda x, i=i: key_data(x).addressable_shards[i].data, state))
        for i in range(2)
    ]
    return [name for name, x in shards[0].items() if not np.array_equal(x, shards[1][name])]


def gradient_gap():
    """The largest relative difference between the gradient of a batch and that of two halves."""
    learner = make_learner()
    state = learner.init(jax.random.key(1))

    @jax.jit
    def make_batch(state):
        keys = jax.random.split(jax.random.key(2), CONFIG.episodes_per_iteration)
        trajectory = learner.play(state.params, keys, jax.random.key(3))
        reward, _ = learner.intrinsic_reward(state, trajectory)
        return learner.make_batch(state, trajectory, reward)[0]

    placement, batch = Placement.of(2, CONFIG), make_batch(state)
    assert placement.mesh is not None

    def gradient(params, batch):
        return placement.axis.mean(jax.grad(learner.loss, has_aux=True)(params, batch)[0])

    halves: Any = jax.tree.map(lambda _: PartitionSpec(None, EPISODES), batch)
    layout = jax.tree.map(lambda _: PartitionSpec(EPISODES), batch.episodes.layout)
    halves = halves._replace(episodes=halves.episodes._replace(layout=layout))
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
        own = jax.random.key_data(axis.own_key(key))[-1:]
        return axis.gather(axis.part(rows)), axis.gather(own)

    given = placement.put((jnp.arange(6), jax.random.key(0)))
    rows, words = placement.local(jax.jit(placement.shard(both))(*given))
    return rows.tolist(), len(set(words.tolist()))


def main():
    become_devices(2)
    shared, rows, placement = train(2, 3)
    state = to_arrays(placement.local(shared))
    alone, rows_alone, _ = train(1, 1)
    expected = to_arrays(alone)
    (spread, seed_devices), (together, _) = train_seeds(2), train_seeds(1)
    steps = sum(row["episode_length"] for row in rows) * CONFIG.episodes_per_iteration
    report = {
        "unequal_copies": unequal_copies(shared),
        "iteration": int(state["iteration"]),
        "transitions": int(state["transitions"]),
        "steps_played": round(float(steps)),
        "gradient_gap": gradient_gap(),
        "shared_rows": shared_rows(),
        "seed_devices": seed_devices,
        "seeds_gap": max(
            float(np.max(np.abs(np.float64(spread[name]) - x))) for name, x in together.items()
        ),
        "different_shapes": [
            name
            for name, x in expected.items()
            if (state[name].dtype, state[name].shape) != (x.dtype, x.shape)
        ],
        "different_metrics": sorted(set(rows[0]) ^ set(rows_alone[0])),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
