"""Loop-free draws against those of JAX, and the check of keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from easy import assert_same, rows
from refusal import assert_refused
from trap_tube_jax.prng import fold_in, loop_free, typed_key

OPTIMISED = False  # few draws

DRAWS = {
    "bits": lambda key: jax.random.bits(key, (4,), jnp.uint32),
    "bytes": lambda key: jax.random.bits(key, (3, 5), jnp.uint8),
    "normal": lambda key: jax.random.normal(key, (5, 3), jnp.float32),
    "randint": lambda key: jax.random.randint(key, (), 0, 5, jnp.int32),
    "split": lambda key: jax.random.key_data(jax.random.split(key, 3)),
    "chain": lambda key: jax.random.bits(
        jax.random.fold_in(jax.random.split(key)[1], 3), (), jnp.uint32
    ),
}


def all_draws(key):
    return {name: draw(jax.random.clone(key)) for name, draw in DRAWS.items()}


def test_draws_are_those_of_jax():
    keys = jax.random.split(jax.random.key(7, impl="threefry2x32"), 100)
    expected = jax.jit(jax.vmap(all_draws))(keys)
    loopless = jax.jit(jax.vmap(lambda key: all_draws(loop_free(key))))(keys)
    jax.tree.map(np.testing.assert_array_equal, loopless, expected)
    assert all(len(np.unique(drawn, axis=0)) > 4 for drawn in expected.values())


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg"])
def test_keys_of_either_kind_fold_as_in_jax_and_draw_the_same_tasks(impl):
    key = jax.random.key(5, impl=impl)
    assert_same(fold_in(key, 3), jax.random.fold_in(key, 3))
    reset = tt.make("pstsy").reset
    assert_same(reset(key), reset(jax.random.key(5, impl="threefry2x32")))


def test_draws_of_another_order_than_jaxs_own_are_left_to_jax():
    key = jax.random.key(5, impl="threefry2x32")
    with jax.threefry_partitionable(False):
        assert loop_free(key).dtype == key.dtype


@pytest.mark.parametrize("impl", ["rbg", "unsafe_rbg"])
def test_tasks_of_rbg_keys_do_not_depend_on_the_batch(impl):
    keys = jax.random.split(jax.random.key(5, impl=impl), 4)
    for env in (tt.make("pstsy"), tt.AutoReset(tt.make("pstsy"))):
        batch = jax.vmap(env.reset)(keys)
        for index, key in enumerate(keys):
            assert_same(rows(batch, index), env.reset(key))


@pytest.mark.parametrize("transfer", [tt.perceptual, tt.structural, tt.symbolic])
def test_the_transfers_draw_without_loops(transfer):
    """The environment's reset is as fast as its draws."""
    env = tt.Environment((transfer,))
    key = jax.random.key(0, impl="threefry2x32")
    assert "while" not in jax.jit(env.reset).lower(key).as_text()


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg", "unsafe_rbg"])
def test_raw_keys_serve_as_well_as_typed_ones(impl):
    with jax.default_prng_impl(impl):
        typed, raw = jax.random.key(5), jax.random.PRNGKey(5)
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
def test_what_is_not_one_key_is_refused(key, words):
    for function in TAKE_A_KEY:
        assert_refused(["one PRNG key", "jax.random.key", *words], function, key)
