"""The whole learner on environments that isolate one ability each."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from agents import Config, TrainState, make_train
from agents.network import Core
from agents.rollout import Trajectory, greedy_action, rollout


def learn(env: probes.Probe, iterations: int, **settings: Any) -> tuple[TrainState, Trajectory]:
    """Trains without curiosity, then plays 32 greedy episodes."""
    config = Config(
        max_steps=env.max_steps,
        episodes=64,
        minibatch=32,
        epochs=4,
        curiosity="none",
        filters=(4, 4),
        hidden=16,
        embedding=4,
        chunk=16,
        value_coef=0.5,
        entropy_coef=1e-3,
        learning_rate=1e-2,
        **settings,
    )
    train = make_train(config, env)

    @jax.jit
    def run(key: jax.Array) -> tuple[TrainState, Trajectory]:
        init_key, reset_key = jax.random.split(key)
        state, _ = jax.lax.scan(
            lambda state, _: train.iterate(state), train.init(init_key), length=iterations
        )
        tasks, _ = jax.vmap(env.reset)(jax.random.split(reset_key, 32))
        played = rollout(
            train.agent, state.params, env, tasks, reset_key, choose=greedy_action, chunk=16
        )
        return state, played

    return run(jax.random.key(0))


def test_value_of_a_certain_reward():
    _, played = learn(probes.value_probe(), 30)
    np.testing.assert_allclose(played.value[0], 1.0, atol=0.1)


def test_value_is_discounted():
    state, played = learn(probes.discount_probe(), 60, discount=0.5)
    reward = 1 / state.extrinsic.deviation
    np.testing.assert_allclose(played.value[1], reward, atol=0.2)
    np.testing.assert_allclose(played.value[0], 0.5 * reward, atol=0.2)


@pytest.mark.parametrize(
    ("probe", "best", "iterations"),
    [(probes.policy_probe, 1, 40), (probes.cue_probe, 1, 40), (probes.credit_probe, 5, 60)],
)
def test_policy_earns_all_there_is(probe, best, iterations):
    _, played = learn(probe(), iterations)
    np.testing.assert_array_equal(jnp.sum(played.reward, axis=0), best)


def test_memory():
    _, played = learn(probes.memory_probe(), 150)
    np.testing.assert_array_equal(jnp.sum(played.reward, axis=0), 1)


def test_memory_needs_the_gru(monkeypatch):
    """Without a recurrent state the same learner cannot beat a guess."""
    advance = Core.advance
    monkeypatch.setattr(
        Core, "advance", lambda core, state, inputs: advance(core, jnp.zeros_like(state), inputs)
    )
    _, played = learn(probes.memory_probe(), 150)
    assert jnp.mean(jnp.sum(played.reward, axis=0)) < 0.8
