"""The adapters without their libraries, and the batch whose resets take a step."""

import importlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.jax_settings import needs_threefry
from helpers.trees import assert_same, rows
from trap_tube_jax import vector
from trap_tube_jax.adapters.next_step import NextStepVectorEnvironment

SIZE = 20


def wander(key, state):
    """A cheap transfer that tells tasks apart."""
    column = jax.random.randint(key, (), 6, 12)
    return state.replace(agent=jnp.stack([jnp.int32(9), column]))


ACTIONS = np.random.default_rng(0).integers(0, 4, (6, SIZE, 2), np.int32)


@needs_threefry
def test_next_step_spends_a_step_on_the_reset(monkeypatch):
    # Fewer at a time than end together, so that the resets take more than one round.
    monkeypatch.setattr(vector, "MIN_CHUNK", 8)
    batch = NextStepVectorEnvironment(tt.Environment((wander,), max_steps=4))
    reset = jax.jit(batch.reset)
    step = jax.jit(batch.step)
    state, _ = reset(jax.random.split(jax.random.key(0), SIZE))
    old = slice(1, None, 2)
    inner = state.episodes.inner
    inner = inner.replace(time=inner.time.at[old].set(2))
    state = state.replace(episodes=state.episodes.replace(inner=inner))

    state, _ = step(state, ACTIONS[0])
    state, timestep = step(state, ACTIONS[1])
    assert timestep.truncated[old].all()
    assert timestep.truncated.sum() == SIZE // 2
    np.testing.assert_array_equal(timestep.observation, timestep.final_observation)
    np.testing.assert_array_equal(timestep.observation, jax.vmap(tt.observe)(state.episodes.inner))

    fresh, first = reset(state.episodes.key)
    state, timestep = step(state, ACTIONS[2])
    np.testing.assert_array_equal(timestep.observation[old], first.observation[old])
    assert_same(rows(state, old), rows(fresh, old))
    assert state.episodes.inner.time[::2].tolist() == [3] * (SIZE // 2)
    assert not timestep.done.any()
    assert timestep.discount.all()
    assert not timestep.reward.any()


def test_a_solved_episode_ends_once():
    base = tt.State.from_ascii(["AF.........T"] + ["............"] * 11)
    batch = NextStepVectorEnvironment(tt.Environment(base=base))
    step = jax.jit(batch.step)
    state, _ = jax.jit(batch.reset)(jax.random.split(jax.random.key(0), 2))
    # The first moves onto the food, and ignores its next action.
    pictures = []
    for actions, expected in (
        ([[0, 3], [0, 1]], ([1, 0], [True, False], [0, 1])),
        ([[0, 3], [0, 0]], ([0, 0], [False, False], [1, 1])),
    ):
        state, timestep = step(state, np.array(actions))
        found = (timestep.reward, timestep.terminated, timestep.discount)
        assert tuple(x.tolist() for x in found) == expected
        pictures.append((timestep.observation[0], timestep.final_observation[0]))
    (last, _), (first, final) = pictures
    np.testing.assert_array_equal(final, last)
    assert (first != last).any()
    assert state.episodes.inner.agent.tolist() == [[0, 0], [0, 0]]
    assert state.episodes.inner.time.tolist() == [0, 2]


@pytest.mark.parametrize("library", ["gymnasium", "gymnax"])
def test_an_adapter_without_its_library_says_what_to_install(library, monkeypatch):
    name = f"trap_tube_jax.adapters.to_{library}"
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(ImportError, match=rf"pip install 'trap-tube-jax\[{library}\]'"):
        importlib.import_module(name)
