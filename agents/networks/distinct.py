"""Encoding every distinct observation once: the learner's fast path.

The encoder is a function of the observation alone, it takes nearly all of the time, and
observations repeat: an agent that bumps into a wall sees the same board again, and on the
base task all episodes share their boards. So instead of encoding M observations we

  1. name each by a few integers that determine it (`observation_ids`),
  2. sort the names to find the distinct ones (`group`),
  3. encode one of each, in chunks of fixed size whose number depends on the data
     (`map_rows`, which has its own derivative, since loops of varying length have none, and
     remembers for it what is dear to compute),
  4. hand every observation the features of its representative.

The result is that of encoding all M observations, and so is the gradient, up to the order
of float32 sums. Tests hold both against the plain encoder, which `agents.networks.encoder`
takes apart further, in the same way.
"""

import functools
import math
from typing import Any, NamedTuple, Protocol

import chex
import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.positions import (  # noqa: F401  (used by this name elsewhere)
    NUM_CELLS,
    NUM_POSITIONS,
    cells_at,
    position_id,
)
from trap_tube_jax.state import State

ROW_SLOT_BITS = 16  # of a hash, in the table that `group_rows` looks up
REMEMBERED_BYTES = 2**26  # by one `map_rows`; changes speed, not results


class RowFn(Protocol):
    """What `map_rows` maps: rows to features, row by row."""

    def __call__(self, params: Any, rows: Any, remembered: Any, /) -> tuple[Any, Any]:
        """Maps rows, arrays [chunk, ...], to features and what to remember of them.

        Args:
          params: any pytree.
          rows: pytree of arrays [chunk, ...].
          remembered: None, or what an earlier call with the same arguments returned, to save
            computing it again (`recall`).

        Returns:
          A pytree of arrays [chunk, ...], the features; and a pytree of arrays, or None where
          there is nothing to remember.
        """
        ...


class Groups(NamedTuple):
    """Elements gathered by equality.

    Attributes:
      number: i32[M], the group of every element, counted from 0.
      representative: i32[M], an element of each group; only the first `total` count.
      total: i32[], how many groups there are.
    """

    number: jax.Array
    representative: jax.Array
    total: jax.Array


def group(*keys: jax.Array) -> Groups:
    """Groups M elements that agree in all their keys, integer[M] each."""
    chex.assert_rank(keys, 1)
    chex.assert_equal_shape(keys)
    size = keys[0].size
    *ordered, element = jax.lax.sort((*keys, jnp.arange(size)), num_keys=len(keys))
    first = functools.reduce(jnp.logical_or, (_differs_from_previous(key) for key in ordered))
    number = jnp.cumsum(first, dtype=jnp.int32) - 1
    zeros = jnp.zeros(size, jnp.int32)
    return Groups(
        number=zeros.at[element].set(number, unique_indices=True),
        representative=zeros.at[number].max(element),
        total=number[-1] + 1,
    )


def group_rows(content: jax.Array) -> Groups:
    """Groups rows integer[M, K] that agree everywhere.

    Every row looks up whom a table names at its hash, and joins them if they are equal. Equal
    rows are in one group unless the table names another for them; different ones never are.
    """
    own = jnp.arange(len(content))
    slot = slots(content, ROW_SLOT_BITS)
    known = jnp.zeros(2**ROW_SLOT_BITS, jnp.int32).at[slot].max(own)[slot]
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
    """A hash i32[M] of rows integer[M, K], below 2**bits, to look them up in a table by."""
    return (_hash_rows(content) >> (32 - bits)).astype(jnp.int32)


def layout_ids(state: State) -> jax.Array:
    """An id i32[B] per episode, equal only for equal boards, palettes and tool extents.

    Args:
      state: B states.
    """
    return group_rows(_layout_content(state)).number


def layout_hash(state: State) -> jax.Array:
    """A hash u32[B] of the boards, palettes and tool extents of B states."""
    return _hash_rows(_layout_content(state))


def map_rows(fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array) -> Any:
    """`fn` on the first `count` rows, a chunk at a time; zeros below.

    Differentiable with respect to `params` only. What `fn` wants remembered is, as far as
    `REMEMBERED_BYTES` go; for the rows after that, the derivative calls it once more.

    Args:
      fn: see `RowFn`.
      chunk: rows per call of `fn`.
      params: any pytree.
      rows: pytree of arrays [M, ...].
      count: i32[], at most M.

    Returns:
      The features, a pytree of arrays [M, ...].
    """
    return _map_rows(fn, chunk, params, rows, count)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _map_rows(fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array) -> Any:
    return _map_rows_forward(fn, chunk, params, rows, count)[0]


def _map_rows_forward(
    fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array
) -> tuple[Any, Any]:
    num_rows = len(jax.tree.leaves(rows)[0])
    padded = _pad_rows(rows, chunk)
    num_chunks = len(jax.tree.leaves(padded)[0]) // chunk
    shapes = jax.eval_shape(fn, params, _take(padded, 0, chunk), None)
    num_bytes = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes[1]))
    num_remembered = min(REMEMBERED_BYTES // max(num_bytes, 1), num_chunks)

    def body(index: jax.Array, outputs: tuple[Any, Any]) -> tuple[Any, Any]:
        results = fn(params, _take(padded, index, chunk), None)
        # One more place than is remembered, for all chunks that are not.
        places = (index, jnp.minimum(index, num_remembered))
        return tuple(
            jax.tree.map(lambda all_of, new, place=place: all_of.at[place].set(new), *both)
            for place, *both in zip(places, outputs, results, strict=True)
        )

    def empty(length: int, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        return jnp.zeros((length, *leaf.shape), leaf.dtype)

    outputs = tuple(
        jax.tree.map(functools.partial(empty, length), shape)
        for length, shape in zip((num_chunks, num_remembered + 1), shapes, strict=True)
    )
    features, memory = jax.lax.fori_loop(0, _num_chunks(count, chunk), body, outputs)
    features = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:num_rows], features)
    return features, (params, rows, count, memory)


def _map_rows_backward(
    fn: RowFn, chunk: int, residuals: Any, cotangent: Any
) -> tuple[Any, None, None]:
    params, rows, count, memory = residuals
    rows, cotangent = _pad_rows((rows, cotangent), chunk)
    num_remembered = min((len(kept) - 1 for kept in jax.tree.leaves(memory)), default=math.inf)

    def body(index: jax.Array, gradient: Any) -> Any:
        part = _take(rows, index, chunk)
        remembered = jax.tree.map(lambda kept: kept[index], memory)
        if num_remembered < len(jax.tree.leaves(rows)[0]) // chunk:
            remembered = jax.lax.cond(
                index < num_remembered, lambda: remembered, lambda: fn(params, part, None)[1]
            )
        _, pullback = jax.vjp(lambda p: fn(p, part, remembered)[0], params)
        (contribution,) = pullback(_take(cotangent, index, chunk))
        return jax.tree.map(jnp.add, gradient, contribution)

    zero = jax.tree.map(jnp.zeros_like, params)
    return jax.lax.fori_loop(0, _num_chunks(count, chunk), body, zero), None, None


_map_rows.defvjp(_map_rows_forward, _map_rows_backward)


@jax.custom_jvp
def recall(value: jax.Array, remembered: jax.Array) -> jax.Array:
    """`remembered` in place of the equal `value`, which is differentiated but not computed."""
    del value
    return remembered


@recall.defjvp
def _(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    return primals[1], tangents[0]


@jax.custom_batching.custom_vmap
def shared_maximum(x: jax.Array) -> jax.Array:
    """The maximum of a scalar over all vmapped axes, the same in every batch element.

    A loop whose trip count differs between batch elements has to carry both outcomes of
    every element through selects; one that runs as long as the longest does not.
    """
    return x


@shared_maximum.def_vmap
def _(axis_size: int, in_batched: list[bool], x: jax.Array) -> tuple[jax.Array, bool]:
    del axis_size, in_batched
    return shared_maximum(jnp.max(x)), False


def _hash_rows(content: jax.Array) -> jax.Array:
    """u32[M]: a hash of each row of integer[M, K]."""
    weights = np.random.default_rng(0).integers(1, 2**32, content.shape[1], np.uint32)
    return jnp.sum(content.astype(jnp.uint32) * weights[None], axis=1, dtype=jnp.uint32)


def _layout_content(state: State) -> jax.Array:
    """u8[B, ...]: all that an episode keeps, one row each."""
    parts = (state.board, state.palette, state.tool_extent.astype(jnp.uint8))
    return jnp.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def _num_chunks(count: jax.Array, chunk: int) -> jax.Array:
    return shared_maximum((count + chunk - 1) // chunk)


def _pad_rows(rows: Any, chunk: int) -> Any:
    """Adds zero rows up to a multiple of `chunk`."""

    def pad(x: jax.Array) -> jax.Array:
        return jnp.pad(x, [(0, -len(x) % chunk)] + [(0, 0)] * (x.ndim - 1))

    return jax.tree.map(pad, rows)


def _take(rows: Any, index: jax.Array | int, chunk: int) -> Any:
    return jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, index * chunk, chunk, axis=0), rows
    )


def _differs_from_previous(key: jax.Array) -> jax.Array:
    """bool[M]: whether an element differs from the one before it; true at the first."""
    return jnp.concatenate([jnp.ones(1, bool), key[1:] != key[:-1]])
