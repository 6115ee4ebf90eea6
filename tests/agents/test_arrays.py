"""Pytrees to tables of arrays and back; errors name what does not fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.arrays import from_arrays, key_data, to_arrays

TREE = {
    "kernel": jnp.arange(6, dtype=jnp.float32).reshape(2, 3),
    "key": jax.random.split(jax.random.key(7), 2),
    "other": (jax.random.key(1), (), jnp.array([3, 4], jnp.int32)),
}


def test_trees_come_back_bit_for_bit():
    back = from_arrays(to_arrays(TREE), jax.eval_shape(lambda: TREE))
    assert jax.tree.structure(back) == jax.tree.structure(TREE)
    for x, y in zip(jax.tree.leaves(TREE), jax.tree.leaves(back), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(key_data(x), key_data(y))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kernel": jnp.zeros(2, jnp.float32)}, r"kernel is float32\[2, 3\], not float32\[2\]"),
        ({"kernel": jnp.zeros((2, 3), jnp.int32)}, r"kernel is float32\[2, 3\], not int32"),
        ({"key": jax.random.key(0)}, r"key is uint32\[2, .\], not uint32\[.\]"),
        ({"more": jnp.zeros(1)}, "more is missing"),
        ({"other": ()}, "other/0 is not expected"),
    ],
)
def test_misfits_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        from_arrays(to_arrays(TREE), {**TREE, **change})


def test_arrays_share_no_memory_with_a_donated_state():
    state = jnp.zeros(1000)
    arrays = to_arrays({"x": state})
    jax.jit(lambda x: x + 1, donate_argnums=0)(state).block_until_ready()
    np.testing.assert_array_equal(arrays["x"], np.zeros(1000))
