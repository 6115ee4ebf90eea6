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


def environment(name):
    env = tt.make(name)
    step = jax.jit(env.step)
    state, timestep = env.reset(jax.random.key(0))
    action = yield timestep.observation, 0, False
    while True:
        state, timestep = step(state, action)
        action = yield timestep.observation, timestep.reward, timestep.done


def gymnasium_environment(name):
    env = TrapTubeEnv(name)
    action = yield env.reset(seed=0)[0], 0, False
    while True:
        observation, reward, terminated, truncated, _ = env.step(action)
        action = yield observation, reward, terminated or truncated


def gymnasium_batch(name):
    envs = TrapTubeVectorEnv(name, 2)
    action = yield envs.reset(seed=0)[0][1], 0, False
    while True:
        observations, rewards, terminated, truncated, _ = envs.step([action] * 2)
        assert rewards[0] == rewards[1]
        action = yield observations[1], rewards[1], (terminated | truncated)[1]


def gymnax_environment(name):
    env, params = to_gymnax.make(name, flat_actions=False)
    observation, state = env.reset(jax.random.key(0), params)
    action = yield observation, 0, False
    while True:
        observation, state, reward, done, _ = env.step(jax.random.key(1), state, action, params)
        action = yield observation, reward, done


@pytest.mark.parametrize(
    "played", [environment, gymnasium_environment, gymnasium_batch, gymnax_environment]
)
def test_every_interface_has_the_evaluators_successes(played, expected):
    def success(name):
        game, carry = played(name), POLICY.initial(1)
        observation, reward, done = next(game)
        while not done:
            action, carry = ACT(observation[None], carry)
            observation, reward, done = game.send(np.asarray(action[0]))
        return 100 * float(reward)

    assert list(map(success, NAMES)) == expected
