"""Encoding every distinct observation once: the learner's fast path.

The encoder is a function of the observation alone, it takes nearly all of the time, and
observations repeat: an agent that bumps into a wall sees the same board again, and on the
base task all episodes share their boards. So instead of encoding M observations we

  1. name each by a few integers that determine it (`observation_ids`),
  2. sort the names to find the distinct ones (`group`),
  3. encode one of each, in chunks of fixed size whose number depends on the data
     (`map_rows`, which has its own derivative, since loops of varying length have none),
  4. hand every observation the features of its representative.

The result is that of encoding all M observations, and so is the gradient, up to the order
of float32 sums. Tests hold both against the plain encoder.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.state import State

RowFn = Callable[[Any, Any], jax.Array]

NUM_CELLS = BOARD_SIZE * BOARD_SIZE
NUM_POSITIONS = NUM_CELLS**3  # of agent, tool and food together


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


def layout_ids(state: State) -> jax.Array:
    """An id i32[B] per episode, equal only for equal boards, palettes and tool extents.

    Layouts are ordered by a hash and compared with their neighbours, so equal layouts get
    one id unless hashes collide; different ones never share an id.

    Args:
      state: B states.
    """
    content = _layout_content(state)
    batch = len(content)
    _, order = jax.lax.sort((layout_hash(state), jnp.arange(batch)), num_keys=1)
    content = content[order]
    differs = jnp.any(content[1:] != content[:-1], axis=1)
    number = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(differs, dtype=jnp.int32)])
    return jnp.zeros(batch, jnp.int32).at[order].set(number, unique_indices=True)


def layout_hash(state: State) -> jax.Array:
    """A hash u32[B] of the boards, palettes and tool extents of B states."""
    content = _layout_content(state)
    weights = np.random.default_rng(0).integers(1, 2**32, content.shape[1], np.uint32)
    return jnp.sum(content.astype(jnp.uint32) * weights[None], axis=1, dtype=jnp.uint32)


def position_id(state: State) -> jax.Array:
    """An id i32[] of where agent, tool and food are; with the layout it fixes the observation."""
    cells = [state.agent, state.tool, state.food]
    agent, tool, food = (cell[0] * BOARD_SIZE + cell[1] for cell in cells)
    return (agent * NUM_CELLS + tool) * NUM_CELLS + food


def cells_at(position: jax.Array) -> jax.Array:
    """u8[3, 2]: the cells of agent, tool and food with this id; inverse of `position_id`."""
    agent_and_tool, food = jnp.divmod(position, NUM_CELLS)
    cell = jnp.stack([*jnp.divmod(agent_and_tool, NUM_CELLS), food])
    return jnp.stack([cell // BOARD_SIZE, cell % BOARD_SIZE], axis=1).astype(jnp.uint8)


def map_rows(fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array) -> jax.Array:
    """`fn(params, rows)` on the first `count` rows, a chunk at a time; zeros below.

    Differentiable with respect to `params` only.

    Args:
      fn: maps parameters and [chunk, ...] rows to f32[chunk, F], row by row.
      chunk: rows per call of `fn`.
      params: any pytree.
      rows: pytree of arrays [M, ...].
      count: i32[], at most M.

    Returns:
      f32[M, F].
    """
    features: Any = _map_rows(fn, chunk, params, rows, count)
    return features


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _map_rows(fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array) -> jax.Array:
    num_rows = len(jax.tree.leaves(rows)[0])
    rows = _pad_rows(rows, chunk)
    size = len(jax.tree.leaves(rows)[0])
    width = jax.eval_shape(fn, params, _take(rows, 0, chunk)).shape[1]

    def body(index: jax.Array, features: jax.Array) -> jax.Array:
        result = fn(params, _take(rows, index, chunk))
        return jax.lax.dynamic_update_slice_in_dim(features, result, index * chunk, axis=0)

    features = jnp.zeros((size, width))
    return jax.lax.fori_loop(0, _num_chunks(count, chunk), body, features)[:num_rows]


def _map_rows_forward(
    fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array
) -> tuple[jax.Array, Any]:
    return map_rows(fn, chunk, params, rows, count), (params, rows, count)


def _map_rows_backward(
    fn: RowFn, chunk: int, residuals: Any, cotangent: jax.Array
) -> tuple[Any, None, None]:
    params, rows, count = residuals
    rows, cotangent = _pad_rows((rows, cotangent), chunk)

    def body(index: jax.Array, gradient: Any) -> Any:
        _, pullback = jax.vjp(lambda p: fn(p, _take(rows, index, chunk)), params)
        (contribution,) = pullback(_take(cotangent, index, chunk))
        return jax.tree.map(jnp.add, gradient, contribution)

    zero = jax.tree.map(jnp.zeros_like, params)
    return jax.lax.fori_loop(0, _num_chunks(count, chunk), body, zero), None, None


_map_rows.defvjp(_map_rows_forward, _map_rows_backward)


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
