"""Trains on 8 simulated devices and on one, with checkpoints between them; prints what differs.

A process of its own for `test_sharding.py`: the number of devices is fixed once JAX starts.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

import trap_tube_jax as tt
from agents.acting.evaluation import evaluate
from agents.arrays import to_arrays
from agents.config import Config
from agents.networks.agent import Agent
from agents.parallel.sharding import EPISODES, Placement, Shards
from agents.ppo.learner import make_train
from agents.runs.checkpoint import Checkpoints, digest
from trap_tube_jax.scoring.tasks import evaluation_tasks

SEEDS = 2
CONFIG = Config.preset(
    "fast",
    env_id="TrapTube-v0",
    curiosity="icm",
    episodes_per_iteration=16,
    minibatch_size=8,
    epochs=2,
    max_steps=6,
    filters=(2, 2),
    hidden=4,
    embedding=2,
    eval_episodes=3,
    encode_chunk_size=8,
)


class Trainer:
    """Training with one seed a device, from the default device and back to it."""

    def __init__(self, placement, seeds):
        self.placement = placement
        train = make_train(CONFIG, shards=placement.episodes)
        self.init = jax.jit(jax.vmap(train.init))

        def advance(state):
            result = train.iterate(jax.tree.map(lambda x: x[0], state))
            return jax.tree.map(lambda x: x[None], result)

        self.advance = jax.jit(placement.shard(advance))

    def __call__(self, state, iterations):
        state, rows = self.placement.put(state), []
        for _ in range(iterations):
            state, metrics = self.advance(state)
            rows.append(jax.tree.map(np.asarray, metrics))
        return self.placement.local(state), rows


def first_state(trainer):
    return trainer.init(jax.vmap(jax.random.key)(np.arange(SEEDS, dtype=np.uint32)))


def rows_of(tree, index):
    return jax.tree.map(lambda x: x[index : index + 1], tree)


def on_one_device(state, iterations):
    """Each seed alone, then side by side again."""
    alone = Trainer(Placement.of(1, CONFIG, 1), 1)
    results = [alone(rows_of(state, seed), iterations) for seed in range(SEEDS)]
    arrays = [to_arrays(state) for state, _ in results]
    return (
        {name: np.concatenate([part[name] for part in arrays]) for name in arrays[0]},
        [
            {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
            for rows in zip(*(rows for _, rows in results), strict=True)
        ],
    )


def play(params, tasks, devices):
    """Greedy play of tasks by a number of devices, which share them."""
    env = tt.make("st", max_steps=CONFIG.max_steps)

    def own(params, tasks):
        return evaluate(Agent(CONFIG), params, env, tasks, Shards(devices))

    mesh = Mesh(np.array(jax.devices()[:devices]), EPISODES)
    whole = PartitionSpec()
    shared = jax.shard_map(own, mesh=mesh, in_specs=whole, out_specs=whole, check_vma=False)
    return jax.tree.map(np.asarray, jax.jit(shared)(params, tasks))


def difference(one, other):
    """The largest difference, relative where numbers exceed 1, by name."""
    assert set(one) == set(other)
    gap = {
        name: np.max(np.abs(np.float64(one[name]) - other[name]) / np.maximum(1, np.abs(one[name])))
        for name in one
    }
    worst = max(gap, key=lambda name: gap[name])
    return {"name": worst, "gap": float(gap[worst])}


def is_same(one, other):
    """Equal in every bit, or within rounding where it is no choice but a value."""
    if one.dtype == np.float32:
        return bool(np.allclose(one, other, atol=1e-5))
    return bool(np.array_equal(one, other))


def main(folder):
    assert len(jax.devices()) == 8
    placement = Placement.of("all", CONFIG, SEEDS)
    assert placement.mesh is not None
    trainer = Trainer(placement, SEEDS)
    start = first_state(trainer)
    expected, expected_rows = on_one_device(start, 3)
    found, rows = trainer(start, 3)
    # Eight devices save after one iteration, and go on from what is read back.
    once, _ = trainer(start, 1)
    with Checkpoints(folder, keep=1) as checkpoints:
        checkpoints.save(1, once, {})
        restored, _ = checkpoints.restore(jax.eval_shape(lambda: start))
    from_eight, _ = on_one_device(restored, 2)
    twice, _ = trainer(restored, 2)
    params = jax.tree.map(lambda x: np.asarray(x[0]), once.params)
    tasks = {name: evaluation_tasks(name, 3) for name in ("base", "st")}
    played = [
        {name: play(params, states, devices) for name, states in tasks.items()}
        for devices in (1, 8)
    ]
    same = jax.tree.map(is_same, *played)
    head = "params/heads/params/move/kernel"
    report = {
        "mesh": dict(placement.mesh.shape),
        "state": difference(expected, to_arrays(found)),
        "metrics": [difference(*pair) for pair in zip(expected_rows, rows, strict=True)],
        "learned": float(np.max(np.abs(expected[head] - to_arrays(start)[head]))),
        "eight_to_one": difference(expected, from_eight),
        "eight_to_eight": digest(to_arrays(twice)) == digest(to_arrays(found)),
        "evaluation": all(jax.tree.leaves(same)),
        "tasks": {name: len(outcome.solved) for name, outcome in played[1].items()},
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
