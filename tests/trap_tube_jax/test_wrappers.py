"""Starting over: the wrapper `AutoReset`."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.easy_task import DOWN, EASY, RIGHT
from helpers.refusal import assert_refused
from helpers.trees import assert_same, rows

LIMIT = 6
TURNS = 40
ROWS = 256


class Turns(NamedTuple):
    """Steps of an auto-resetting environment: NumPy arrays [time, row, ...]."""

    before: tt.State
    action: np.ndarray
    after: tt.State
    timestep: Any


@pytest.fixture(scope="module")
def auto_reset() -> Turns:
    """Many short episodes [time, row], of which some succeed and every one looks different."""
    env = tt.Environment((tt.structural,), base=EASY, max_steps=LIMIT)
    wrapped = tt.AutoReset(env)

    def turn(state, action):
        after, timestep = jax.vmap(wrapped.step)(state, action)
        return after, Turns(state.inner, action, after.inner, timestep)

    @jax.jit
    def run(key):
        reset_key, action_key = jax.random.split(key)
        state, first = jax.vmap(wrapped.reset)(jax.random.split(reset_key, ROWS))
        actions = jax.random.randint(action_key, (TURNS, ROWS, 2), 0, 4)
        return first, jax.lax.scan(turn, state, actions)[1]

    first, turns = jax.tree.map(np.asarray, run(jax.random.key(3)))
    np.testing.assert_array_equal(first.observation, first.final_observation)
    ends = turns.timestep.terminated.sum(), turns.timestep.truncated.sum()
    assert min(ends) > 100
    return turns


def test_auto_reset_takes_the_plain_step_first(auto_reset):
    env = tt.Environment(base=EASY, max_steps=LIMIT)
    step = jax.jit(jax.vmap(jax.vmap(env.step)))
    plain, timestep = step(auto_reset.before, auto_reset.action)
    for name in ("reward", "terminated", "truncated", "discount"):
        np.testing.assert_array_equal(
            getattr(auto_reset.timestep, name), getattr(timestep, name), err_msg=name
        )
    np.testing.assert_array_equal(auto_reset.timestep.final_observation, timestep.observation)
    going_on = ~np.asarray(timestep.done)
    assert_same(rows(auto_reset.after, going_on), rows(plain, going_on))


def test_auto_reset_shows_the_next_episode_where_one_ended(auto_reset):
    after = auto_reset.after
    timestep = auto_reset.timestep
    shown = jax.jit(jax.vmap(jax.vmap(tt.observe)))(after)
    np.testing.assert_array_equal(timestep.observation, shown)
    done = np.asarray(timestep.done)
    fresh = rows(after, done)
    np.testing.assert_array_equal(fresh.time, 0)
    np.testing.assert_array_equal(fresh.agent, np.broadcast_to(EASY.agent, fresh.agent.shape))
    assert not np.any(fresh.terminated | fresh.truncated)
    looks = np.asarray(fresh.palette).reshape(done.sum(), -1)
    assert len(np.unique(looks, axis=0)) == done.sum()


class Shaped:
    """A user's wrapper."""

    def __init__(self, env):
        self.env = env

    def reset(self, key):
        return self.env.reset(key)

    def step(self, state, action):
        state, timestep = self.env.step(state, action)
        return state, timestep.replace(reward=timestep.reward - 0.5)


def test_auto_reset_refuses_environments_that_reset_themselves():
    inner = tt.AutoReset(tt.Environment())
    assert_refused(["AutoReset resets itself", "trap_tube_jax.Environment"], tt.AutoReset, inner)
    words = ["Shaped resets itself", "trap_tube_jax.Environment"]
    assert_refused(words, tt.AutoReset(Shaped(inner)).reset, jax.random.key(0))


@pytest.mark.parametrize("env", [None, "base", tt.Environment, tt.base_state()])
def test_what_is_no_environment_is_refused(env):
    assert_refused(["reset(key) and step(state, action)"], tt.AutoReset, env)


def test_a_state_of_another_kind_is_refused():
    env = tt.AutoReset(tt.make("base"))
    _, timestep = env.reset(jax.random.key(0))
    for state in (timestep, tt.base_state()):
        words = [f"AutoResetState, got {type(state).__name__}", "return (state, timestep)"]
        assert_refused(words, env.step, state, jnp.array([DOWN, RIGHT]))
