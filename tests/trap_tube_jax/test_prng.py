"""Loop-free draws against those of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from trap_tube_jax.prng import fold_in, loop_free, split, threefry

# Salmon et al. (2011), known answers of Threefry-2x32 with 20 rounds: key, counter, result.
KNOWN = [
    ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
    ((0xFFFFFFFF,) * 2, (0xFFFFFFFF,) * 2, (0x1CB996FC, 0xBB002BE7)),
    ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
]
DRAWS = {
    "bits": lambda key: jax.random.bits(key, (4,), jnp.uint32),
    "bytes": lambda key: jax.random.bits(key, (3, 5), jnp.uint8),
    "normal": lambda key: jax.random.normal(key, (5, 3)),
    "randint": lambda key: jax.random.randint(key, (), 0, 5),
    "permutation": lambda key: jax.random.permutation(key, 7),
    "split": lambda key: jax.random.key_data(jax.random.split(key, 3)),
    "fold_in": lambda key: jax.random.key_data(jax.random.fold_in(key, 2**31 + 5)),
    "chain": lambda key: jax.random.uniform(jax.random.fold_in(jax.random.split(key)[1], 3), (2,)),
}


@pytest.mark.parametrize(("key", "counter", "result"), KNOWN)
def test_the_hash_is_threefry(key, counter, result):
    hashed = threefry(jnp.array(key, jnp.uint32), *map(jnp.uint32, counter))
    assert tuple(map(int, hashed)) == result


@pytest.mark.parametrize("name", DRAWS)
def test_draws_are_those_of_jax(name):
    keys = jax.random.split(jax.random.key(7), 100)
    draw = DRAWS[name]
    expected = jax.vmap(draw)(keys)
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(lambda key: draw(loop_free(key))))(keys), expected
    )
    raw = jax.random.key_data(keys)
    np.testing.assert_array_equal(jax.vmap(lambda key: draw(loop_free(key)))(raw), expected)
    assert len(np.unique(expected, axis=0)) > 4


def test_other_keys_stay_what_they_are():
    key = jax.random.key(0, impl="rbg")
    assert loop_free(key) is key
    with jax.threefry_partitionable(False):
        key = jax.random.key(0)
        assert loop_free(key) is key


KEYS = {
    "typed": jax.random.key(5),
    "raw": jax.random.PRNGKey(5),
    "rbg": jax.random.key(5, impl="rbg"),
    "loop-free": loop_free(jax.random.key(5)),
}


@pytest.mark.parametrize("key", KEYS.values(), ids=KEYS)
def test_split_gives_the_same_keys_of_the_same_type(key):
    for ours, theirs in zip(split(key), jax.random.split(key), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(jax.random.key_data(ours), jax.random.key_data(theirs))


@pytest.mark.parametrize("key", KEYS.values(), ids=KEYS)
def test_fold_in_gives_the_same_key_of_the_same_type(key):
    ours, theirs = fold_in(key, 3), jax.random.fold_in(key, 3)
    assert ours.dtype == theirs.dtype
    np.testing.assert_array_equal(jax.random.key_data(ours), jax.random.key_data(theirs))


@pytest.mark.parametrize("transfer", [tt.perceptual, tt.structural, tt.symbolic])
def test_the_transfers_draw_without_loops(transfer):
    """The environment's reset is as fast as its draws."""
    env = tt.Environment((transfer,))
    assert "while" not in jax.jit(env.reset).lower(jax.random.key(0)).as_text()


def test_a_loop_free_key_stays_one():
    key = loop_free(jax.random.key(0))
    assert loop_free(key) is key
    assert "while" not in jax.jit(jax.random.bits).lower(key).as_text()
    assert "while" in jax.jit(jax.random.bits).lower(jax.random.key(0)).as_text()
