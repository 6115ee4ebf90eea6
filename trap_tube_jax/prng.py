"""PRNG keys: conversion to typed keys, and to keys whose draws do not depend on the batch."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


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
        if key.dtype == np.uint32 and key.shape == raw_shape():
            return jax.random.wrap_key_data(jnp.asarray(key))
        found = f"{key.dtype} of shape {key.shape}"
    raise ValueError(
        f"expected one PRNG key, got {found}; make one with jax.random.key(seed), and jax.vmap "
        "over several"
    )


def raw_shape() -> tuple[int, ...]:
    """Returns the shape of a raw key under `jax_default_prng_impl`."""
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0))).shape


def threefry_key(key: Any) -> jax.Array:
    """Returns one PRNG key, typed or raw, as a typed key whose draws do not depend on the batch.

    A key of `rbg` or `unsafe_rbg` becomes the Threefry key in its first two words: under
    `jax.vmap`, draws of `rbg` depend on the batch and would repeat tasks. Returns other keys
    unchanged.

    Raises:
      ValueError: `key` is not one PRNG key.
    """
    key = typed_key(key)
    if str(jax.random.key_impl(key)) not in ("rbg", "unsafe_rbg"):
        return key
    return jax.random.wrap_key_data(jax.random.key_data(key)[:2], impl="threefry2x32")
