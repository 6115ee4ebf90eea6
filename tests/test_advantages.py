"""Advantages of two streams of rewards, normalised apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, make_train
from agents.acting.episodes import Episodes
from agents.ppo import advantages, returns
from agents.ppo.learner import RESERVED_NAMES

TINY = {
    "env_id": "pstsy", "episodes": 8, "minibatch": 4, "epochs": 1, "filters": (4, 4),
    "hidden": 4, "embedding": 2, "max_steps": 6, "chunk": 8, "failures": 5,
    "replayed": (0.25, 0.25),
}  # fmt: skip


def test_after_an_episode_comes_one_that_is_worth_the_mean_of_all_starts():
    value = jnp.array([[1.0, 3.0], [5.0, 6.0], [7.0, 8.0]])
    mask = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    found = advantages.continuing_value(value, mask)
    np.testing.assert_array_equal(found, [[1.0, 3.0], [5.0, 2.0], [2.0, 2.0]])


def test_a_loud_stream_does_not_drown_the_other():
    task = 100 * jax.random.normal(jax.random.key(0), (20, 30))
    curiosity = jax.random.normal(jax.random.key(1), (20, 30))
    mask = jnp.ones((20, 30))
    found = advantages.joint_advantage(task, curiosity, 0.5, mask)
    for stream, scale in ((task, 1.0), (curiosity, 0.5)):
        slope = np.polyfit(np.ravel(stream / jnp.std(stream)), np.ravel(found), 1)[0]
        assert slope == pytest.approx(scale, abs=0.1)


def test_a_stream_that_hardly_pays_is_not_blown_up():
    task = 1e-4 * jax.random.normal(jax.random.key(0), (20, 30))
    joint = advantages.joint_advantage(task, jnp.zeros((20, 30)), 1.0, jnp.ones((20, 30)))
    assert np.abs(joint).max() < 0.1


def test_the_intrinsic_weight_falls_geometrically():
    config = Config(intrinsic_start=8.0, intrinsic_scale=0.5, intrinsic_fall=0.4, iterations=10)
    weight = advantages.intrinsic_scale(config)
    found = np.array([weight(iteration) for iteration in range(6)])
    np.testing.assert_allclose(found, [8, 4, 2, 1, 0.5, 0.5], rtol=1e-6)
    constant = advantages.intrinsic_scale(Config(intrinsic_scale=0.7))
    assert [constant(iteration) for iteration in (0, 9)] == [0.7, 0.7]


def test_training_with_two_streams_replays_and_frames():
    train = make_train(Config.preset("best", **TINY))
    state = train.init(jax.random.key(0))
    assert state.params["heads"]["params"]["value"]["kernel"].shape == (4, 2)
    after, metrics = jax.jit(train.iterate)(state)
    # Of the episodes that are new, those that were failed are remembered.
    failed = round(train.config.num_new * (1 - float(metrics["success"])))
    assert int(after.failures.next[0]) == failed % TINY["failures"]
    assert 0 <= float(metrics["replayed_success"]) <= 1
    assert all(np.isfinite(float(value)) for value in metrics.values())
    assert metrics.keys() <= RESERVED_NAMES  # the curiosity has no losses


def test_without_curiosity_the_task_has_the_only_value():
    train = make_train(Config.preset("best", **TINY, curiosity="none"))
    params = jax.eval_shape(train.init_params, jax.random.key(0))
    assert params["heads"]["params"]["value"]["kernel"].shape == (4, 1)
    value = jax.random.normal(jax.random.key(2), (7, 8, 1))
    ones = jnp.ones((6, 8))
    episodes = Episodes(tt.base_state(), ones, ones, ones, ones, ones)
    moments = (returns.Moments.zero(), returns.Moments.zero())
    found, target, _ = advantages.of_streams(
        train.config, episodes, jnp.zeros((6, 8)), 3.0, value, moments
    )
    expected = advantages.advantages_and_targets(train.config, ones, episodes, value[..., 0])
    np.testing.assert_array_equal(found, expected[0])
    np.testing.assert_array_equal(target[..., 0], expected[1])


def test_more_steps_than_can_be_counted_are_refused():
    with pytest.raises(ValueError, match=r"2,560,000,000 steps; allowed: at most 2,147,483,647"):
        make_train(Config(max_steps=10_000))
