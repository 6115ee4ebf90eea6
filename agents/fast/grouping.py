"""Groups of equal elements or rows."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from agents.networks.hashing import hash_rows

GROUPING_BITS = 16  # hash bits; the table of `group_rows` has a slot for each value


class Groups(NamedTuple):
    """A partition of M elements into groups of equal elements.

    Attributes:
      group_id: i32[M], the group of every element, counted from 0.
      representative: i32[M], an element of each group; only the first `total` count.
      total: i32[], the number of groups.
    """

    group_id: jax.Array
    representative: jax.Array
    total: jax.Array


def group(*keys: jax.Array) -> Groups:
    """Groups M elements that agree in all their keys, i32[M] each, and orders groups by keys."""
    rows = jnp.stack(keys, axis=1)
    _, first, group_id = jnp.unique(
        rows, axis=0, return_index=True, return_inverse=True, size=len(rows)
    )
    group_id = group_id.astype(jnp.int32)
    return Groups(group_id, first.astype(jnp.int32), jnp.max(group_id) + 1)


def group_rows(content: jax.Array) -> Groups:
    """Groups equal rows integer[M, K], faster than `group` but not always completely.

    Each row is compared with one row of the same hash, and joins its group if the two are equal.
    Different rows are never in one group. Equal rows may be in two if hashes collide.
    """
    index = jnp.arange(len(content), dtype=jnp.int32)
    slot = slots(content, GROUPING_BITS)
    known = jnp.zeros(2**GROUPING_BITS, jnp.int32).at[slot].max(index)[slot]
    known = jnp.where(jnp.all(content[known] == content, axis=1), known, index)
    first = known == index
    group_id = jnp.cumsum(first, dtype=jnp.int32) - 1
    zeros = jnp.zeros(len(content), jnp.int32)
    return Groups(
        group_id=group_id[known],
        representative=zeros.at[jnp.where(first, group_id, len(content))].set(index, mode="drop"),
        total=group_id[-1] + 1,
    )


def slots(content: jax.Array, bits: int) -> jax.Array:
    """Hashes rows integer[..., K] to table indices i32[...] below 2**bits."""
    return (hash_rows(content) >> np.uint32(32 - bits)).astype(jnp.int32)
