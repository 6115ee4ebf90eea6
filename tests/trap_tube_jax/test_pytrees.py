"""Objects that users hold between calls are ordinary pytrees, with the batch first."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.easy_task import EASY
from helpers.trees import assert_same, bits, rows
from trap_tube_jax.adapters.next_step import NextStepVectorEnvironment

OPTIMISED = False  # few steps
BATCH = 3
ACTIONS = np.array([[3, 3], [3, 1], [0, 0]], np.int32)
SHORT = tt.Environment((tt.structural,), base=EASY, max_steps=2)
ENVIRONMENTS: dict[str, Any] = {
    "plain": SHORT,
    "without transfers": tt.Environment(),
    "auto-reset": tt.AutoReset(SHORT),
    "vector": tt.VectorEnvironment(SHORT),
    "next-step vector": NextStepVectorEnvironment(SHORT),
}


def functions_of(name):
    """Returns the reset and step of a batch."""
    env = ENVIRONMENTS[name]
    if "vector" in name:
        return env.reset, env.step
    return jax.vmap(env.reset), jax.vmap(env.step)


def held_by(name, transform):
    """Returns (state, timestep) after a reset and after a step."""
    reset, step = map(transform, functions_of(name))
    first = reset(jax.random.split(jax.random.key(0), BATCH))
    return first, step(first[0], ACTIONS)


HELD = {
    f"{name}, {way}": lambda name=name, transform=transform: held_by(name, transform)
    for name in ENVIRONMENTS
    for way, transform in (("eager", lambda function: function), ("compiled", jax.jit))
} | {
    "evaluation tasks": lambda: [tt.evaluation_tasks("sy", BATCH)],
    "plans": lambda: [tt.solve_batch(tt.evaluation_tasks("sy", BATCH))],
}


def identity(tree):
    return tree


def reset_where(done, initial, carry):
    """Starts some rows over, as a generic loop does."""

    def select(new, old):
        return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return jax.tree.map(select, initial, carry)


def copied(leaf):
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.clone(leaf) if is_key else jnp.copy(leaf)


@pytest.mark.parametrize("make", HELD.values(), ids=HELD)
def test_an_object_is_a_pytree_with_the_batch_first_and_no_buffer_twice(make):
    for held in make():
        assert {len(leaf) for leaf in jax.tree.leaves(held)} == {BATCH}
        expected = jax.tree.map(bits, held)
        for same in (
            jax.jit(identity)(held),
            jax.vmap(identity)(held),
            jax.tree.map(identity, held),
            jax.device_put(held, jax.devices()[0]),
            jax.lax.scan(lambda carry, row: (carry, row), 0, held)[1],
        ):
            assert_same(same, expected)
        initial, other, given = (jax.tree.map(copied, held) for _ in range(3))
        other = rows(other, np.array([1, 2, 0]))
        mixed = reset_where(np.array([True, False, False]), initial, other)
        assert_same(mixed, rows(expected, np.array([0, 2, 0])))
        # XLA refuses to donate a buffer that is there twice.
        given = jax.device_put(given)
        assert_same(jax.jit(lambda x: jax.tree.map(copied, x), donate_argnums=0)(given), expected)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_loop_may_donate_its_state(name):
    reset, step = functions_of(name)
    kept, _ = reset(jax.random.split(jax.random.key(0), BATCH))
    given = jax.tree.map(copied, kept)
    donating = jax.jit(step, donate_argnums=0)
    keeping = jax.jit(step)
    for _ in range(3):
        given, donated_timestep = donating(given, ACTIONS)
        kept, timestep = keeping(kept, ACTIONS)
        assert_same((given, donated_timestep), (kept, timestep))
