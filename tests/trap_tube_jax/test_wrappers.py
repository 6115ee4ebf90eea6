"""Starting over and counting: the wrappers `AutoReset` and `EpisodeStatistics`."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.easy_task import DOWN, EASY, RIGHT
from helpers.refusal import assert_refused
from helpers.trees import assert_same, rows
from trap_tube_jax.adapters.next_step import NextStepVectorEnvironment

LIMIT = 6
TURNS = 40
ROWS = 256


class Turns(NamedTuple):
    """An auto-resetting environment with statistics: NumPy arrays [time, row, ...]."""

    before: tt.State
    action: np.ndarray
    after: tt.State
    timestep: Any
    statistics: Any


@pytest.fixture(scope="module")
def auto_reset() -> Turns:
    """Many short episodes [time, row], of which some succeed and every one looks different."""
    env = tt.Environment((tt.structural,), base=EASY, max_steps=LIMIT)
    counted = tt.EpisodeStatistics(tt.AutoReset(env))

    def turn(state, action):
        after, timestep = jax.vmap(counted.step)(state, action)
        statistics = after.replace(inner=None)
        return after, Turns(state.inner.inner, action, after.inner.inner, timestep, statistics)

    @jax.jit
    def run(key):
        reset_key, action_key = jax.random.split(key)
        state, first = jax.vmap(counted.reset)(jax.random.split(reset_key, ROWS))
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


def test_episode_statistics_count_returns_and_lengths(auto_reset):
    done = auto_reset.timestep.done
    reward = auto_reset.timestep.reward
    for row in range(ROWS):
        length = 0
        total = 0.0
        episodes = 0
        last = (0, 0.0)
        for time in range(TURNS):
            length = length + 1
            total = total + reward[time, row]
            if done[time, row]:
                episodes = episodes + 1
                last = (length, total)
                length = 0
                total = 0.0
            counted = rows(auto_reset.statistics, (time, row))
            assert (counted.last_length, counted.last_return) == last
            assert (counted.running_length, counted.running_return) == (length, total)
            assert counted.episodes == episodes


def test_episode_statistics_around_a_bare_environment_count_one_episode():
    env = tt.EpisodeStatistics(tt.Environment(base=EASY, max_steps=9))
    step = jax.jit(env.step)
    state, _ = env.reset(jax.random.key(0))
    for _ in range(5):
        state, _ = step(state, RIGHT)
    assert (state.episodes, state.last_length, state.last_return) == (1, 2, 1)


@pytest.mark.parametrize(
    ("vector", "num_steps"), [(tt.VectorEnvironment, 6), (NextStepVectorEnvironment, 8)]
)
def test_episode_statistics_of_a_vector_count_its_environments_without_resets(vector, num_steps):
    """Two steps solve the task of the first, three end that of the second; a reset may take one."""
    fast = tt.EpisodeStatistics(vector(tt.Environment(base=EASY, max_steps=3)))

    @jax.jit
    def run(keys):
        state, _ = fast.reset(keys)
        actions = jnp.broadcast_to(jnp.stack([RIGHT, DOWN]), (num_steps, 2, 2))
        return jax.lax.scan(fast.step, state, actions)[0]

    state = run(jax.random.split(jax.random.key(0), 2))
    np.testing.assert_array_equal(state.episodes, [3, 2])
    np.testing.assert_array_equal(state.last_length, [2, 3])
    np.testing.assert_array_equal(state.last_return, [1, 0])
    np.testing.assert_array_equal(state.running_length, [0, 0])


class Shaped:
    """A user's wrapper."""

    def __init__(self, env):
        self.env = env

    def reset(self, key):
        return self.env.reset(key)

    def step(self, state, action):
        state, timestep = self.env.step(state, action)
        return state, timestep.replace(reward=timestep.reward - 0.5)


def test_a_users_wrapper_does_not_hide_auto_reset():
    inner = Shaped(tt.AutoReset(tt.Environment(base=EASY, max_steps=9)))
    env = tt.EpisodeStatistics(inner)
    step = jax.jit(env.step)
    state, _ = env.reset(jax.random.key(0))
    for _ in range(4):
        state, _ = step(state, RIGHT)
    assert (state.episodes, state.last_length, state.last_return) == (2, 2, 0)
    words = ["Shaped resets itself", "trap_tube_jax.Environment"]
    assert_refused(words, tt.AutoReset(inner).reset, jax.random.key(0))


@pytest.mark.parametrize("wrapper", [tt.VectorEnvironment, tt.AutoReset])
def test_auto_reset_refuses_environments_that_reset_themselves_or_count(wrapper):
    env = wrapper(tt.Environment())
    words = [wrapper.__name__, "resets itself", "trap_tube_jax.Environment"]
    assert_refused(words, tt.AutoReset, env)
    assert_refused(["resets itself"], tt.AutoReset, tt.EpisodeStatistics(env))
    counting = tt.EpisodeStatistics(tt.Environment())
    assert_refused(["allowed: EpisodeStatistics(AutoReset(env))"], tt.AutoReset, counting)


@pytest.mark.parametrize("wrap", [tt.AutoReset, tt.EpisodeStatistics])
@pytest.mark.parametrize("env", [None, "base", tt.Environment, tt.base_state()])
def test_what_is_no_environment_is_refused(wrap, env):
    assert_refused(["reset(key) and step(state, action)"], wrap, env)


@pytest.mark.parametrize("wrap", [tt.AutoReset, tt.EpisodeStatistics])
def test_a_state_of_another_kind_is_refused(wrap):
    env = wrap(tt.make("base"))
    _, timestep = env.reset(jax.random.key(0))
    for state in (timestep, tt.base_state()):
        words = [f"{wrap.__name__}State, got {type(state).__name__}", "return (state, timestep)"]
        assert_refused(words, env.step, state, jnp.array([DOWN, RIGHT]))
