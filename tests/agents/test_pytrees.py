"""Objects that users hold go through JAX's transformations, and their batch comes first."""

import gc
import pickle
import weakref
from copy import deepcopy
from typing import Any

import jax
import jax.numpy as jnp
import pytest

import trap_tube_jax as tt
from agents import make_learner
from helpers.small_runs import small_config
from helpers.tiny_policy import food_next_to_agent, random_policy
from helpers.trees import assert_same, rows

BATCH = 4
OBJECTS = {
    "policy": random_policy,
    "carry": lambda: random_policy(align_to_food=True, repeat_penalty=3.0).initial(BATCH),
    "carry of draws": lambda: random_policy().replace(greedy=False).initial(BATCH),
    "learner": lambda: make_learner(small_config()),
    "train state": lambda: make_learner(small_config()).init(jax.random.key(0)),
}


def is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def moved(leaf: Any) -> Any:
    if is_key(leaf):
        return jax.random.wrap_key_data(jax.random.key_data(leaf) + 1)
    return leaf ^ True if leaf.dtype == bool else leaf + jnp.ones((), leaf.dtype)


@pytest.mark.parametrize("name", OBJECTS)
def test_objects_go_through_transformations(name):
    """No buffer occurs twice: it could be donated only once."""
    held = OBJECTS[name]()
    assert_same(jax.jit(lambda x: x)(held), held)
    assert_same(jax.device_put(held), held)
    assert_same(jax.lax.scan(lambda x, _: (x, None), held, length=2)[0], held)
    twice = jax.vmap(lambda _, x: x, in_axes=(0, None), out_axes=0)(jnp.arange(2), held)
    assert_same(rows(twice, 1), held)
    expected = jax.tree.map(moved, held)
    assert_same(jax.jit(lambda x: jax.tree.map(moved, x), donate_argnums=0)(held), expected)


@pytest.mark.parametrize("settings", [{}, {"align_to_food": True, "repeat_penalty": 3.0}])
def test_an_episode_is_reset_by_its_row_of_the_carry(settings):
    """Rows that `where` resets act as from the start, the others as if nothing had happened."""
    policy = random_policy(4, **settings)
    act = jax.jit(policy.act)
    observation = jax.vmap(tt.observe)(food_next_to_agent())
    initial = policy.initial(BATCH)
    assert {len(leaf) for leaf in jax.tree.leaves(initial)} == {BATCH}
    carry = initial
    for _ in range(3):
        _, carry = act(observation, carry)
    done = jnp.array([True, False, True, False])

    def reset(start: jax.Array, now: jax.Array) -> jax.Array:
        return jnp.where(done.reshape(-1, *[1] * (now.ndim - 1)), start, now)

    after = act(observation, jax.tree.map(reset, initial, carry))
    wanted = [act(observation, initial), act(observation, carry)]
    for row in range(BATCH):
        expected = wanted[0 if done[row] else 1]
        assert_same(rows(after, row), rows(expected, row))


def test_a_policys_leaves_are_its_parameters():
    policy = random_policy()
    assert len(jax.tree.leaves(policy)) == len(jax.tree.leaves(policy.params))
    halved = jax.tree.map(lambda x: x / 2, policy)
    assert (halved.iteration, halved.config) == (policy.iteration, policy.config)
    assert_same(halved.params, jax.tree.map(lambda x: x / 2, policy.params))


def test_a_learner_is_pickled_and_copied():
    learner = make_learner(small_config())
    key = jax.random.key(0)
    for copy in (pickle.loads(pickle.dumps(learner)), deepcopy(learner)):
        assert (copy.config, copy.env) == (learner.config, learner.env)
        assert_same(copy.init(key).params, learner.init(jax.random.clone(key)).params)


def test_a_learner_is_freed_with_its_last_reference():
    learner = make_learner(small_config())
    learner.init(jax.random.key(0))
    seen = weakref.ref(learner)
    del learner
    gc.collect()
    assert seen() is None
