"""What an iteration of training makes of its parts: tasks, weights of rewards, gradient steps.

Play and gradient steps are replaced where they are not what is tested.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import trap_tube_jax as tt
from agents import Config, make_train
from agents.acting.episodes import Episodes
from agents.acting.rollout import Trajectory
from agents.arrays import to_arrays
from agents.ppo import advantages, learner
from agents.ppo.learner import RESERVED_NAMES, Learner, TrainState

BEST = Config.preset(
    "best",
    episodes_per_iteration=8,
    minibatch_size=4,
    epochs=3,
    filters=(4, 4),
    hidden=4,
    embedding=2,
    max_steps=6,
    encode_chunk_size=8,
    replay_capacity=5,
    replay_fractions=(0.25, 0.25),
    iterations=10,
    max_transitions=None,
)
STEPS, EPISODES = 6, 8
SOLVED = np.array([True, False, False, False, False, True, True, True])  # 4 new, 2, 2


class Scripted(Learner):
    """Plays tasks of known keys, solves those of `SOLVED`, and does not learn."""

    def draw_tasks(self, task_replay, key):
        return reset_keys()

    def play(self, params, reset_keys, action_key):
        del params, action_key
        shape = (STEPS, len(reset_keys))
        reward = jnp.zeros(shape).at[-1].set(SOLVED)
        episodes = Episodes(
            layout=jax.tree.map(lambda x: jnp.stack([x] * EPISODES), tt.base_state()),
            cells=jnp.zeros((STEPS + 1, EPISODES, 3, 2), jnp.uint8),
            action=jnp.zeros((*shape, 2), jnp.int32),
            reward=reward,
            discount=1 - reward,
            mask=jnp.ones(shape),
        )
        value = jax.random.normal(
            jax.random.key(3), (STEPS + 1, EPISODES, self.config.num_value_heads)
        )
        nothing = jnp.zeros((*shape, 0))
        return Trajectory(episodes, nothing, nothing, jnp.zeros(shape), value)

    def intrinsic_reward(self, state, trajectory):
        return jax.random.uniform(jax.random.key(4), (STEPS, EPISODES)), state.memory

    def optimize(self, state, batch, key):
        return state.params, state.opt_state, {"advantage": batch.advantage}


def reset_keys() -> jax.Array:
    return jax.random.split(jax.random.key(5), EPISODES)


def data(keys: jax.Array) -> list[tuple[int, ...]]:
    """Keys as what can be compared."""
    return [tuple(key) for key in np.asarray(jax.random.key_data(keys)).reshape(-1, 2)]


@pytest.fixture(scope="module")
def scripted() -> tuple[Learner, TrainState, Any]:
    """A scripted learner, its first state, and its iteration, compiled."""
    parts = vars(make_train(BEST))
    train = Scripted(**parts)
    return train, train.init(jax.random.key(0)), jax.jit(train.iterate)


def test_new_tasks_are_new_and_others_are_of_the_lists():
    train = make_train(BEST)
    task_replay = train.init(jax.random.key(0)).task_replay
    drawn = data(train.draw_tasks(task_replay, jax.random.key(1)))
    once, twice = data(task_replay.keys[0]), data(task_replay.keys[1])
    assert len(set(drawn[:4]) - {*once, *twice}) == 4
    assert set(drawn[4:6]) <= set(once)
    assert set(drawn[6:]) <= set(twice)


def test_tasks_that_failed_are_remembered_and_success_is_that_on_new_tasks(scripted):
    _, state, iterate = scripted
    after, metrics = iterate(state)
    keys, first, second = data(reset_keys()), *map(data, state.task_replay.keys)
    # New tasks 1, 2, 3 failed, and of the tasks failed once the first.
    assert data(after.task_replay.keys[0]) == [*keys[1:4], *first[3:]]
    assert data(after.task_replay.keys[1]) == [keys[4], *second[1:]]
    assert float(metrics["success"]) == 1 / 4
    assert float(metrics["replayed_success"]) == 3 / 4


def test_an_iteration_counts_what_was_played(scripted):
    _, state, iterate = scripted
    after, metrics = iterate(iterate(state)[0])
    assert int(after.iteration) == 2
    assert int(after.episodes) == 2 * EPISODES
    assert int(after.transitions) == 2 * EPISODES * STEPS
    assert float(metrics["episode_length"]) == STEPS


@pytest.mark.parametrize(("iteration", "weight"), [(0, 3.0), (4, 0.3), (8, 0.03), (9, 0.03)])
def test_the_weight_of_curiosity_is_that_of_the_iteration(scripted, iteration, weight):
    train, state, iterate = scripted
    _, metrics = iterate(state._replace(iteration=jnp.int32(iteration)))
    trajectory = train.play(None, reset_keys(), None)
    novelty, _ = train.intrinsic_reward(state, trajectory)
    moments = (state.extrinsic, state.intrinsic)
    expected, _, _ = advantages.separate_advantages(
        BEST, trajectory.episodes, novelty, weight, trajectory.value, moments
    )
    # Normalised once more.
    expected = (expected - expected.mean()) / expected.std()
    np.testing.assert_allclose(metrics["advantage"], expected, atol=1e-4)


def test_episodes_are_played_facing_the_food(monkeypatch):
    first: Any = lambda agent, params, env, initial, key, choose: initial  # noqa: E731
    monkeypatch.setattr(learner, "rollout", first)
    keys = jax.random.split(jax.random.key(1), 64)
    start: Any = jax.jit(make_train(BEST).play)({}, keys, jax.random.key(2))
    down, right = np.asarray(start.food - start.agent).T
    assert np.all((down >= right) & (right >= 0))
    drawn, _ = jax.jit(jax.vmap(tt.make("pstsy").reset))(keys)
    assert not np.all(drawn.food >= drawn.agent)


def test_no_key_is_used_twice(monkeypatch):
    """Those of two iterations, of their resets, steps and gradient steps."""
    used: list[tuple[int, ...]] = []

    def note(key):
        jax.debug.callback(lambda key: used.extend(data(key)), key)

    class Environment(tt.Environment):
        def reset(self, key):
            note(key)
            return super().reset(key)

    def choose(key, actions):
        note(key)
        return actions.mode()

    class Playing(Learner):
        def prepare(self, state, trajectory) -> Any:
            note(state.key)
            return state, trajectory, {}

        def optimize(self, state, batch, key):
            note(key)
            return state.params, state.opt_state, {}

    monkeypatch.setattr(learner, "sample_action", choose)
    small = {
        "max_steps": STEPS,
        "filters": (2, 2),
        "hidden": 4,
        "embedding": 2,
        "encode_chunk_size": 4,
    }
    config = Config(**small, episodes_per_iteration=EPISODES, minibatch_size=4, curiosity="none")
    train = Playing(**vars(make_train(config, Environment(max_steps=STEPS))))
    state, iterate = train.init(jax.random.key(0)), jax.jit(train.iterate)
    iterate(iterate(state)[0])
    jax.effects_barrier()
    assert len(set(used)) == len(used) == 2 * (1 + EPISODES + STEPS + 1 + 1)


def recorder(updates: int) -> optax.GradientTransformation:
    """Plain gradient descent, whose state holds all gradients [updates, EPISODES]."""

    def init(params: Any) -> Any:
        return jnp.zeros((), jnp.int32), jnp.zeros((updates, *params.shape))

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        count, seen = state
        return -updates, (count + 1, seen.at[count].set(updates))

    return optax.GradientTransformation(init, update)


class Counting(Learner):
    """Its gradient is 1 at the episodes of the minibatch."""

    def loss(self, params: Any, batch: Any):
        return jnp.sum(params[batch["number"][0]]), {"entropy": jnp.ones(()), "steps": jnp.ones(())}


def test_every_epoch_takes_every_episode_once_and_in_an_order_of_its_own():
    updates = BEST.gradient_steps
    train = Counting(**{**vars(make_train(BEST)), "optimizer": recorder(updates)})
    params = jnp.zeros(EPISODES)
    state = TrainState(params, train.optimizer.init(params), *[None] * 8)  # pyright: ignore
    batch: Any = {"number": jnp.arange(EPISODES)[None]}
    after, (count, seen), _ = train.optimize(state, batch, jax.random.key(0))
    assert count == updates == 3 * 2
    np.testing.assert_array_equal(after, -3)
    epochs = np.asarray(seen).reshape(3, 2, EPISODES)
    np.testing.assert_array_equal(epochs.sum(axis=2), 4)
    np.testing.assert_array_equal(epochs.sum(axis=1), 1)
    assert len({epoch[0].tobytes() for epoch in epochs}) > 1


@pytest.mark.slow
def test_seeds_side_by_side_are_those_alone():
    """With the cache of encodings and the loops of the real rollout; up to rounding."""
    small = {
        "max_steps": 4,
        "episodes_per_iteration": 4,
        "minibatch_size": 4,
        "epochs": 1,
        "encode_chunk_size": 4,
    }
    network = {"filters": (2, 3), "hidden": 4, "embedding": 2}
    train = make_train(Config(**small, **network, env_id="sy", curiosity="none"))
    both = jax.vmap(train.init)(jax.vmap(jax.random.key)(jnp.array([3, 4])))
    together, alone = jax.jit(jax.vmap(train.iterate))(both), jax.jit(train.iterate)
    for seed in range(2):
        expected = to_arrays(alone(jax.tree.map(lambda x, i=seed: x[i], both)))
        got = to_arrays(jax.tree.map(lambda x, i=seed: x[i], together))
        assert got.keys() == expected.keys()
        for name, array in got.items():
            np.testing.assert_allclose(array, expected[name], rtol=1e-4, atol=1e-5, err_msg=name)


def test_an_iteration_of_best_is_finite_and_changes_all_parameters():
    train = make_train(dataclasses.replace(BEST, epochs=1))
    state = train.init(jax.random.key(0))
    assert state.params["heads"]["params"]["value"]["kernel"].shape == (4, 2)
    after, metrics = jax.jit(train.iterate)(state)
    assert all(np.isfinite(float(value)) for value in metrics.values())
    assert metrics.keys() <= RESERVED_NAMES  # the curiosity has no losses
    before, after = to_arrays(state.params), to_arrays(after.params)
    same = [name for name in before if np.array_equal(before[name], after[name])]
    assert same == ["core/params/reward_embedding/kernel"]  # no reward was met
