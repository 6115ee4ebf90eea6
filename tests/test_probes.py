"""The whole learner on environments that isolate one ability each."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from agents import Config, make_train
from agents.acting.rollout import Trajectory, greedy_action, rollout
from agents.networks.core import Core

DISCOUNT, ITERATIONS = 0.5, 100
CONFIG = Config(
    max_steps=probes.STEPS,
    episodes=64,
    minibatch=32,
    epochs=4,
    curiosity="none",
    discount=DISCOUNT,
    filters=(4, 4),
    hidden=16,
    embedding=4,
    chunk=16,
    value_coef=0.5,
    entropy_coef=1e-3,
    learning_rate=5e-3,
    iterations=ITERATIONS,
    cooldown=0.7,
)
# Kinds of probes, and whether the network has its recurrent state.
CASES = [(kind, True) for kind in probes.KINDS] + [("memory", False), ("cue", False)]


class Learnt(NamedTuple):
    """The extrinsic reward as it enters the targets, and 32 greedy episodes."""

    reward: jax.Array
    played: Trajectory


@pytest.fixture(scope="module")
def learnt() -> dict[tuple[str, bool], Learnt]:
    """All cases, trained side by side."""
    advance = Core.advance

    def run(kind: jax.Array, remembers: jax.Array) -> Learnt:
        def maybe_forget(core: Core, state: jax.Array, inputs: jax.Array) -> jax.Array:
            return advance(core, jnp.where(remembers, state, 0), inputs)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Core, "advance", maybe_forget)
            return train_and_play(kind, jax.random.key(0))

    kinds = jnp.array([probes.KINDS.index(kind) for kind, _ in CASES])
    results = jax.jit(jax.vmap(run))(kinds, jnp.array([remembers for _, remembers in CASES]))
    return {case: jax.tree.map(lambda x, i=i: x[i], results) for i, case in enumerate(CASES)}


def train_and_play(kind: jax.Array, key: jax.Array) -> Learnt:
    env = probes.Probe(kind)
    train = make_train(CONFIG, env)
    init_key, reset_key = jax.random.split(key)
    state, _ = jax.lax.scan(
        lambda state, _: train.iterate(state), train.init(init_key), length=ITERATIONS
    )
    tasks, _ = jax.vmap(env.reset)(jax.random.split(reset_key, 32))
    played = rollout(
        train.agent, state.params, env, tasks, reset_key, choose=greedy_action, chunk=16
    )
    return Learnt(1 / state.extrinsic.deviation, played)


def test_value_of_a_certain_reward(learnt):
    reward, played = learnt["value", True]
    np.testing.assert_allclose(played.value[0, :, 0], reward, rtol=0.1)
    np.testing.assert_allclose(played.value[1:-1, :, 0] / reward, 0.0, atol=0.1)


def test_value_is_discounted(learnt):
    reward, played = learnt["discount", True]
    for time in range(probes.STEPS):
        expected = reward * DISCOUNT ** (probes.STEPS - 1 - time)
        np.testing.assert_allclose(played.value[time, :, 0], expected, rtol=0.1)


@pytest.mark.parametrize("kind", ["policy", "cue", "credit", "memory"])
def test_policy_earns_all_there_is(learnt, kind):
    played = learnt[kind, True].played
    np.testing.assert_array_equal(jnp.sum(played.episodes.reward, axis=0), 1)


def test_memory_needs_the_gru(learnt):
    """Without a recurrent state the same learner cannot beat a guess, in sight it can."""
    without = {kind: learnt[kind, False].played.episodes for kind in ("memory", "cue")}
    assert jnp.mean(jnp.sum(without["memory"].reward, axis=0)) < 0.8
    np.testing.assert_array_equal(jnp.sum(without["cue"].reward, axis=0), 1)
