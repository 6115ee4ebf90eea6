"""The adapters without their libraries, and the batch behind the Gymnasium adapter."""

import functools
import importlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from trap_tube_jax.adapters.batch import CHUNK, reset_batch, step_batch

SIZE = CHUNK + 8  # so that ends fill more than one chunk


def wander(key, state):
    """A cheap transfer that tells tasks apart."""
    column = jax.random.randint(key, (), 6, 12)
    return state.replace(agent=jnp.stack([jnp.int32(9), column]))


@pytest.fixture(scope="module")
def env():
    return tt.Environment((wander,), max_steps=4)


@pytest.fixture(scope="module")
def start(env):
    """States of all ages, so that few, many, all and no episodes end at a step."""
    state, observation = reset_batch(env, jax.random.split(jax.random.key(0), SIZE))
    ages = jnp.arange(SIZE, dtype=jnp.int32) % 2 * 2
    return state.replace(inner=state.inner.replace(time=ages)), observation


ACTIONS = np.random.default_rng(0).integers(0, 4, (6, SIZE, 2), np.int32)


def assert_same(one, other):
    """Equal leaves; keys are compared by their bits."""
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        is_key = jnp.issubdtype(left.dtype, jax.dtypes.prng_key)
        bits = jax.random.key_data if is_key else np.asarray
        np.testing.assert_array_equal(bits(left), bits(right))


def test_same_step_is_the_vmapped_auto_reset(env, start):
    batched = jax.jit(functools.partial(step_batch, env, same_step=True))
    single = jax.jit(jax.vmap(tt.AutoReset(env).step))
    state = expected = start[0]
    ends = []
    for actions in ACTIONS:
        state, timestep = batched(state, actions)
        expected, expected_timestep = single(expected, actions)
        assert_same((state, timestep), (expected, expected_timestep))
        ends.append(int(timestep.done.sum()))
    assert ends == [0, SIZE // 2, 0, SIZE // 2, 0, SIZE // 2]


def test_next_step_spends_a_step_on_the_reset(env, start):
    batched = jax.jit(functools.partial(step_batch, env, same_step=False))
    old = slice(1, None, 2)  # at time 2 of 4
    state, _ = batched(start[0], ACTIONS[0])
    state, timestep = batched(state, ACTIONS[0])
    assert timestep.truncated[old].all()
    assert timestep.truncated.sum() == SIZE // 2
    np.testing.assert_array_equal(timestep.observation, timestep.final_observation)
    fresh, observation = reset_batch(env, state.key)
    state, timestep = batched(state, ACTIONS[1])
    np.testing.assert_array_equal(timestep.observation[old], observation[old])
    assert_same(jax.tree.map(lambda x: x[old], state), jax.tree.map(lambda x: x[old], fresh))
    assert not timestep.done.any()
    assert timestep.discount.all()
    assert not timestep.reward.any()


@pytest.mark.parametrize("library", ["gymnasium", "gymnax"])
def test_an_adapter_without_its_library_says_what_to_install(library, monkeypatch):
    name = f"trap_tube_jax.adapters.to_{library}"
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(ImportError, match=r"pip install 'trap-tube-jax\[interop\]'"):
        importlib.import_module(name)
