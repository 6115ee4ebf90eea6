"""A trained policy drives other libraries' interfaces as it drives the environment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluator
from tiny_policy import FOOD_CELLS, STEPS, random_policy
from trap_tube_jax import registry

pytest.importorskip("gymnasium")
pytest.importorskip("gymnax")

from trap_tube_jax.adapters import to_gymnax
from trap_tube_jax.adapters.to_gymnasium import TrapTubeEnv, TrapTubeVectorEnv

pytestmark = pytest.mark.interop
NAMES = [f"Near{index}-v0" for index in range(len(FOOD_CELLS))]
POLICY = random_policy()
ACT = jax.jit(POLICY.act)


@pytest.fixture(scope="module", autouse=True)
def expected():
    """The percentages of four sets of one task each, by the evaluator."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_task_sets", dict(registry._task_sets))
        for name, cell in zip(NAMES, FOOD_CELLS, strict=True):
            base = tt.base_state(1).replace(food=jnp.array(cell, jnp.int32))
            tt.register(name, (), base=base, max_steps=STEPS)
        evaluator = Evaluator.of_sets(POLICY.config, NAMES, 1)
        found = [score.percent for score in evaluator.scores(evaluator(POLICY.params))]
        assert 0 < np.mean(found) < 100
        yield found


def percent(returns):
    return [100.0 * value for value in returns]


def test_the_environment(expected):
    def reward(name):
        env, carry = tt.make(name), POLICY.initial(1)
        state, timestep = env.reset(jax.random.key(0))
        total, step = 0.0, jax.jit(env.step)
        while not timestep.done:
            action, carry = ACT(timestep.observation[None], carry)
            state, timestep = step(state, action[0])
            total += float(timestep.reward)
        return total

    assert percent(map(reward, NAMES)) == expected


def test_gymnasiums_single_environment(expected):
    def reward(name):
        env, carry, over, total = TrapTubeEnv(name), POLICY.initial(1), False, 0.0
        observation, _ = env.reset(seed=0)
        while not over:
            action, carry = ACT(observation[None], carry)
            observation, gained, terminated, truncated, _ = env.step(np.asarray(action[0]))
            over, total = terminated or truncated, total + gained
        return total

    assert percent(map(reward, NAMES)) == expected


def test_gymnasiums_vector_environment(expected):
    def reward(name):
        envs, carry = TrapTubeVectorEnv(name, 2), POLICY.initial(2)
        over, total = np.zeros(2, bool), np.zeros(2)
        observation, _ = envs.reset(seed=0)
        while not over.all():
            action, carry = ACT(observation, carry)
            observation, gained, terminated, truncated, _ = envs.step(np.asarray(action))
            total += gained * ~over
            over |= terminated | truncated
        assert total[0] == total[1]
        return total[0]

    assert percent(map(reward, NAMES)) == expected


def test_gymnaxs_step(expected):
    def reward(name):
        (env, params), carry = to_gymnax.make(name, flat_actions=False), POLICY.initial(1)
        observation, state = env.reset(jax.random.key(0), params)
        done, total = False, 0.0
        while not done:
            action, carry = ACT(observation[None], carry)
            observation, state, gained, done, _ = env.step(
                jax.random.key(1), state, action[0], params
            )
            total += float(gained)
        return total

    assert percent(map(reward, NAMES)) == expected
