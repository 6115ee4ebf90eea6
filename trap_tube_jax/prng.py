"""The draws of `jax.random`, without loops: faster where few are needed at a time.

On a CPU, JAX computes its Threefry hash in a loop of five rounds. That is quick to compile, but a
reset needs only a handful of numbers, and starting the loops takes longer than the hash itself.
`loop_free` makes a key whose draws are the same bits, computed without a loop. Such a key has its
own type. It is used inside this package only, and never passed to your code.

Source: Salmon et al. (2011) for the hash; JAX's documentation of `jax_threefry_partitionable`
for how the counters are chosen.
"""

import functools
import math

import jax
import jax.numpy as jnp
from jax.extend.random import define_prng_impl

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA
ROUNDS = 5  # of four rotations each


def loop_free(key: jax.Array) -> jax.Array:
    """The same key, of a type whose draws are computed without loops.

    Args:
      key: one PRNG key, typed or u32[2].

    Returns:
      A typed key; the key itself where it is none of JAX's default kind, or JAX is configured
      to choose counters otherwise (`jax_threefry_partitionable`).
    """
    is_default = str(jax.random.key_impl(key)) == "threefry2x32"
    if not is_default or not jax.config.jax_threefry_partitionable:  # pyright: ignore[reportAttributeAccessIssue]
        return key
    data = key if key.dtype == jnp.uint32 else jax.random.key_data(key)
    return jax.random.wrap_key_data(data, impl=_LOOP_FREE)


def split(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The two keys of `jax.random.split`, of the same type as `key`."""
    pair = _like(jax.random.split(loop_free(key)), key)
    # The barrier keeps this hash apart from those of the draws that follow. As one expression,
    # XLA of jax 0.11 and later compiles them for minutes where there is no batch.
    return jax.lax.optimization_barrier((pair[0], pair[1]))


@functools.partial(jax.jit, static_argnums=1, inline=True)
def fold_in(key: jax.Array, data: int) -> jax.Array:
    """The key of `jax.random.fold_in`, of the same type as `key`."""
    return _like(jax.random.fold_in(loop_free(key), data), key)


def threefry(key: jax.Array, high: jax.Array, low: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Threefry-2x32 with 20 rounds: hashes counters of two words, u32[...] each, with u32[2]."""
    words = (key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(PARITY))
    high, low = high + words[0], low + words[1]
    for index in range(ROUNDS):
        for rotation in ROTATIONS[index % 2]:
            high = high + low
            low = (low << rotation) | (low >> (32 - rotation))
            low = high ^ low
        high = high + words[(index + 1) % 3]
        low = low + words[(index + 2) % 3] + jnp.uint32(index + 1)
    return high, low


def _like(keys: jax.Array, key: jax.Array) -> jax.Array:
    """The same keys, of the type of `key`."""
    if keys.dtype == key.dtype:
        return keys
    data = jax.random.key_data(keys)
    if key.dtype == jnp.uint32:
        return data
    return jax.random.wrap_key_data(data, impl=jax.random.key_impl(key))


def _seed(seed: jax.Array) -> jax.Array:
    return jnp.stack([jnp.zeros((), jnp.uint32), jnp.asarray(seed).astype(jnp.uint32)])


def _counters(shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    """The flat index of every element, as two words."""
    if math.prod(shape) >= 2**32:
        raise ValueError(f"fewer than 2**32 numbers can be drawn at once, got shape {shape}")
    low = jnp.arange(math.prod(shape), dtype=jnp.uint32).reshape(shape)
    return jnp.zeros_like(low), low


def _split(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jnp.stack(threefry(key, *_counters(shape)), axis=-1)


def _random_bits(key: jax.Array, bit_width: int, shape: tuple[int, ...]) -> jax.Array:
    high, low = threefry(key, *_counters(shape))
    if bit_width == 64:
        return (high.astype(jnp.uint64) << 32) | low.astype(jnp.uint64)
    return (high ^ low).astype(f"uint{bit_width}")


def _fold_in(key: jax.Array, data: jax.Array) -> jax.Array:
    return jnp.stack(threefry(key, *_seed(data)))


_LOOP_FREE = define_prng_impl(
    key_shape=(2,),
    seed=_seed,
    split=_split,
    random_bits=_random_bits,
    fold_in=_fold_in,  # pyright: ignore[reportArgumentType]  # gets an array
    name="threefry2x32_loop_free",
    tag="fryl",
)
