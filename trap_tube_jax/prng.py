"""PRNG keys, and the draws of `jax.random` without loops.

On a CPU, JAX computes its Threefry hash in a loop of five rounds. A reset needs a handful of
numbers, and starting the loops takes longer than the hash. Without loops XLA fuses a reset of
{P, St, Sy} into few kernels: the reset takes 0.8 of the time, a step of `jax.vmap` of an
`AutoReset` 0.9. The bits are the same. Loop-free keys have a type of their own and never leave
this package.

Source: Salmon et al. (2011) for the hash; JAX's documentation of `jax_threefry_partitionable`
for the choice of counters.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import define_prng_impl

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = 0x1BD11BDA
ROUNDS = 5  # of four rotations each


def typed_key(key: Any) -> jax.Array:
    """Returns one PRNG key, typed or raw, as a typed key.

    A raw key is an unsigned 32-bit array of the shape that `jax_default_prng_impl` asks for.

    Raises:
      ValueError: `key` is not one PRNG key.
    """
    found = type(key).__name__
    if isinstance(key, jax.Array | np.ndarray):
        if key.shape == () and jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
            return jnp.asarray(key)
        if key.dtype == np.uint32 and key.shape == _raw_shape():
            return jax.random.wrap_key_data(jnp.asarray(key))
        found = f"{key.dtype} of shape {key.shape}"
    raise ValueError(
        f"expected one PRNG key, got {found}; make one with jax.random.key(seed), and jax.vmap "
        "over several"
    )


def _raw_shape() -> tuple[int, ...]:
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0))).shape


def threefry_key(key: Any) -> jax.Array:
    """Returns one PRNG key, typed or raw, as a typed key whose draws do not depend on the batch.

    A key of `rbg` or `unsafe_rbg` becomes the Threefry key in its first two words: under
    `jax.vmap` its own draws depend on the batch, and would repeat tasks. Other keys stay.

    Raises:
      ValueError: `key` is not one PRNG key.
    """
    key = typed_key(key)
    if str(jax.random.key_impl(key)) not in ("rbg", "unsafe_rbg"):
        return key
    return jax.random.wrap_key_data(jax.random.key_data(key)[:2], impl="threefry2x32")


def loop_free(key: Any) -> jax.Array:
    """Returns a key whose draws, of at most 32 bits each, are those of `threefry_key(key)`.

    They are computed without loops, unless `jax_threefry_partitionable` is off. A key of a foreign
    implementation stays as it is.

    Raises:
      ValueError: `key` is not one PRNG key.
    """
    key = threefry_key(key)
    has_loops = not jax.config.jax_threefry_partitionable  # pyright: ignore[reportAttributeAccessIssue]
    if has_loops or str(jax.random.key_impl(key)) != "threefry2x32":
        return key
    return jax.random.wrap_key_data(jax.random.key_data(key), impl=_LOOP_FREE)


def fold_in(key: jax.Array, data: int) -> jax.Array:
    """Returns `jax.random.fold_in(key, data)` of a typed key, computed without loops."""
    impl = jax.random.key_impl(key)
    if str(impl) != "threefry2x32":
        return jax.random.fold_in(key, data)
    folded = jax.random.key_data(jax.random.fold_in(loop_free(key), data))
    return jax.random.wrap_key_data(folded, impl=impl)


def threefry(key: jax.Array, high: jax.Array, low: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Hashes counters of two words, u32[...] each, with u32[2] by 20 rounds of Threefry-2x32."""
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


def _seed(seed: jax.Array) -> jax.Array:
    return jnp.stack([jnp.zeros((), jnp.uint32), jnp.asarray(seed).astype(jnp.uint32)])


def _fold_in(key: jax.Array, data: jax.Array) -> jax.Array:
    return jnp.stack(threefry(key, *_seed(data)))


def _split(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jnp.stack(_hash_indices(key, shape), axis=-1)


def _random_bits(key: jax.Array, bit_width: int, shape: tuple[int, ...]) -> jax.Array:
    high, low = _hash_indices(key, shape)
    return (high ^ low).astype(f"uint{bit_width}")


def _hash_indices(key: jax.Array, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    index = jnp.arange(math.prod(shape), dtype=jnp.uint32).reshape(shape)
    return threefry(key, jnp.zeros_like(index), index)


_LOOP_FREE = define_prng_impl(
    key_shape=(2,),
    seed=_seed,
    split=_split,
    random_bits=_random_bits,
    fold_in=_fold_in,  # pyright: ignore[reportArgumentType]  # gets an array
    name="threefry2x32_loop_free",
    tag="fryl",
)
