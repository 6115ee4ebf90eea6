"""Keys: their kinds, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.refusal import assert_refused
from helpers.trees import assert_same, rows
from trap_tube_jax.prng import typed_key

OPTIMISED = False  # few draws


@pytest.mark.parametrize("impl", ["rbg", "unsafe_rbg"])
def test_keys_of_either_kind_draw_the_same_tasks(impl):
    reset = tt.make("pstsy").reset
    key = jax.random.key(5, impl=impl)
    assert_same(reset(key), reset(jax.random.key(5, impl="threefry2x32")))


def own_transfer(key, state):
    """Draws with the key as it is."""
    return state.replace(agent=state.agent.at[1].set(jax.random.randint(key, (), 0, 12)))


@pytest.mark.parametrize("impl", ["rbg", "unsafe_rbg"])
def test_tasks_of_rbg_keys_do_not_depend_on_the_batch(impl):
    keys = jax.random.split(jax.random.key(5, impl=impl), 4)
    custom = tt.Environment((own_transfer, tt.compose(tt.structural, own_transfer)))
    for env in (tt.make("pstsy"), tt.AutoReset(tt.make("pstsy")), custom):
        batch = jax.jit(jax.vmap(env.reset))(keys)
        reset = jax.jit(env.reset)
        for index, key in enumerate(keys):
            assert_same(rows(batch, index), reset(key))


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg", "unsafe_rbg"])
def test_raw_keys_serve_as_well_as_typed_ones(impl):
    with jax.default_prng_impl(impl):
        typed = jax.random.key(5)
        raw = jax.random.PRNGKey(5)
        for key in (raw, np.asarray(raw), typed):
            assert typed_key(key) == typed
        assert tt.make("st").reset(raw)[0] == tt.make("st").reset(typed)[0]
        assert_refused(["one PRNG key", "(3,)"], typed_key, np.zeros(3, np.uint32))


NO_KEYS = {
    "a number": (0, ["int"]),
    "nothing": (None, ["NoneType"]),
    "a text": ("key", ["str"]),
    "floats": (jnp.zeros(2, jnp.float32), ["float32", "(2,)"]),
    "a batch": (jax.random.split(jax.random.key(0), 3), ["(3,)", "jax.vmap"]),
    "a raw batch": (np.zeros((3, 2), np.uint32), ["(3, 2)", "jax.vmap"]),
}
TAKE_A_KEY = [
    tt.Environment().reset,
    tt.AutoReset(tt.Environment()).reset,
    *(
        lambda key, transfer=transfer: transfer(key, tt.base_state())
        for transfer in (
            *(tt.perceptual, tt.structural, tt.symbolic, tt.compose()),
            *(tt.graded_perceptual(0.5), tt.graded_structural(0.5)),
            *tt.task_set("two-traps").transfers,
        )
    ),
]


@pytest.mark.parametrize(("key", "words"), NO_KEYS.values(), ids=NO_KEYS)
def test_arguments_other_than_one_key_are_refused(key, words):
    for function in TAKE_A_KEY:
        assert_refused(["one PRNG key", "jax.random.key", *words], function, key)
