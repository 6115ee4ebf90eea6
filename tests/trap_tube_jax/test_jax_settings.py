"""The same tasks and types under every configuration of JAX that a user may choose."""

import contextlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.jax_settings import enable_x64
from helpers.trees import assert_same, bits
from trap_tube_jax.scoring import knowledge

OPTIMISED = False  # few steps


def raised_agent(key: jax.Array, state: tt.State) -> tt.State:
    """Moves the agent up, in integers of 64 bits if these are enabled."""
    del key
    return state.replace(agent=jnp.stack([0, jnp.argmax(state.board[0])]))


TRANSFERS = (
    *tt.task_set("two-traps").transfers,
    *(tt.graded_perceptual(0.5), tt.perceptual),
    *(tt.graded_structural(0.5), tt.structural),
    *tt.task_set("sy+base").transfers,
    raised_agent,
)
BASE = tt.base_state().replace(food=np.array([5, 6]))  # int64, NumPy's default
STEPS = 4


def play() -> Any:
    """Episodes of two steps, alone and in a batch, and a picture; keys as their bits."""
    env = tt.Environment(TRANSFERS, base=BASE, max_steps=2)
    alone = tt.AutoReset(tt.make("p", max_steps=2))
    batch = tt.VectorEnvironment(env)
    keys = jax.random.split(jax.random.key(5), 3)
    record: list[Any] = []
    for wrapped, key, shape in ((alone, jax.random.key(6), (2,)), (batch, keys, (3, 2))):
        state, timestep = jax.jit(wrapped.reset)(key)
        step = jax.jit(wrapped.step)
        for _ in range(STEPS):
            record.append((state, timestep))
            state, timestep = step(state, np.ones(shape, int))
    record.append(tt.render(tt.base_state(), 8, grasp=0))
    first_tries = (knowledge.first_push, knowledge.first_grasp)
    record += [find(tt.base_state(), np.ones((2, 2), int)) for find in first_tries]
    record.append(knowledge.choice_of_exit(tt.base_state(), np.array([0, 1], np.int32)))
    record.append((tt.action_from_index(np.arange(16)), tt.action_to_index(np.array([1, 2]))))
    return jax.tree.map(bits, record)


# Settings that are hard on the same code, together.
SETTINGS: dict[str, dict[Any, Any]] = {
    "64 bits, strict": {enable_x64: True, jax.numpy_dtype_promotion: "strict"},
    "keys used once, no NaN": {jax.debug_key_reuse: True, jax.debug_nans: True},
}
if jax.__version_info__ < (0, 8):  # indexing with numbers of several types promotes them inside JAX
    del SETTINGS["64 bits, strict"][jax.numpy_dtype_promotion]


@pytest.fixture(scope="module")
def expected() -> Any:
    return play()


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_episodes_do_not_depend_on_settings_of_jax(expected, settings):
    with contextlib.ExitStack() as stack:
        for context, value in settings.items():
            stack.enter_context(context(value))
        played = play()
    assert_same(played, expected)
