"""Groups of equal elements or rows, and hashes of rows."""

import functools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

GROUPING_BITS = 16  # hash bits; the table of `group_rows` has a slot for each value


class Groups(NamedTuple):
    """A partition of M elements into groups of equal elements.

    Attributes:
      number: i32[M], the group of every element, counted from 0.
      representative: i32[M], an element of each group; only the first `total` count.
      total: i32[], the number of groups.
    """

    number: jax.Array
    representative: jax.Array
    total: jax.Array


def group(*keys: jax.Array) -> Groups:
    """Groups M elements that agree in all their keys, integer[M] each."""
    chex.assert_rank(keys, 1)
    chex.assert_equal_shape(keys)
    size = keys[0].size
    *ordered, element = jax.lax.sort((*keys, jnp.arange(size, dtype=jnp.int32)), num_keys=len(keys))
    differs = [jnp.concatenate([jnp.ones(1, bool), key[1:] != key[:-1]]) for key in ordered]
    number = jnp.cumsum(functools.reduce(jnp.logical_or, differs), dtype=jnp.int32) - 1
    zeros = jnp.zeros(size, jnp.int32)
    return Groups(
        number=zeros.at[element].set(number, unique_indices=True),
        representative=zeros.at[number].max(element),
        total=number[-1] + 1,
    )


def group_rows(content: jax.Array) -> Groups:
    """Groups equal rows integer[M, K], faster than `group` but not always completely.

    Each row is compared with one row of the same hash, and joins its group if the two are equal.
    Different rows are never in one group. Equal rows may be in two if hashes collide.
    """
    own = jnp.arange(len(content), dtype=jnp.int32)
    slot = slots(content, GROUPING_BITS)
    known = jnp.zeros(2**GROUPING_BITS, jnp.int32).at[slot].max(own)[slot]
    known = jnp.where(jnp.all(content[known] == content, axis=1), known, own)
    first = known == own
    number = jnp.cumsum(first, dtype=jnp.int32) - 1
    zeros = jnp.zeros(len(content), jnp.int32)
    return Groups(
        number=number[known],
        representative=zeros.at[jnp.where(first, number, len(content))].set(own, mode="drop"),
        total=number[-1] + 1,
    )


def slots(content: jax.Array, bits: int) -> jax.Array:
    """Hashes rows integer[..., K] to table indices i32[...] below 2**bits."""
    return (hash_rows(content) >> np.uint32(32 - bits)).astype(jnp.int32)


def hash_rows(content: jax.Array) -> jax.Array:
    """Hashes rows integer[..., K] to u32[...]; the high bits are the best."""
    weights = np.random.default_rng(0).integers(1, 2**32, content.shape[-1], np.uint32)
    weights = weights.reshape((1,) * (content.ndim - 1) + (-1,))
    return jnp.sum(content.astype(jnp.uint32) * weights, axis=-1, dtype=jnp.uint32)
