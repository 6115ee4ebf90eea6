"""Applies a function to only the first rows, chunk by chunk, and differentiates it.

Observations repeat, and encoding them takes nearly all of the time. So distinct observations are
put first, and only distinct observations are encoded. Chunks have a fixed size; their number
depends on the data. JAX does not differentiate loops of varying length, but `map_rows` does.
`map_rows` also keeps results for the gradient that are expensive to recompute (20 % of a gradient
step).
"""

import functools
import math
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp

from trap_tube_jax.state import take

REMEMBERED_BYTES = 2**26  # per call of `map_rows`; affects only speed

RowFn = Callable[[Any, Any, Any], tuple[Any, Any]]  # see `map_rows`


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def map_rows(fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array) -> Any:
    """Applies `fn` to the first `count` rows, a chunk at a time; differentiable by `params` only.

    Args:
      fn: maps (params, rows, remembered) to (features, memory). Rows and features are pytrees of
        arrays [chunk, ...]. The memory to keep of these rows is a pytree of arrays or None.
        `remembered` is None, or the memory of an earlier call with the same arguments, to `recall`.
      chunk: rows per call of `fn`; M where there are fewer.
      params: any pytree.
      rows: pytree of arrays [M, ...].
      count: i32[], at most M.

    Returns:
      The features, a pytree of arrays [M, ...]; zeros from the end of the last chunk on.
    """
    return _map_rows_forward(fn, chunk, params, rows, count)[0]


def _map_rows_forward(
    fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array
) -> tuple[Any, Any]:
    parts, num_chunks, chunk = _cut(rows, chunk, "edge")
    shapes = jax.eval_shape(fn, params, take(parts, 0), None)
    num_bytes = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes[1]))
    num_remembered = min(REMEMBERED_BYTES // max(num_bytes, 1), num_chunks)

    def body(index: jax.Array, tables: tuple[Any, Any]) -> tuple[Any, Any]:
        features, memory = fn(params, take(parts, index), None)
        row = jnp.minimum(index, num_remembered)  # the last row absorbs the overflow
        return _put(tables[0], index, features), _put(tables[1], row, memory)

    tables = _table(num_chunks, shapes[0]), _table(num_remembered + 1, shapes[1])
    features, memory = jax.lax.fori_loop(0, _num_chunks(count, chunk), body, tables)
    num_rows = len(jax.tree.leaves(rows)[0])
    features = jax.tree.map(lambda x: jax.lax.collapse(x, 0, 2)[:num_rows], features)
    return features, (params, rows, count, memory)


def _map_rows_backward(
    fn: RowFn, chunk: int, residuals: Any, cotangent: Any
) -> tuple[Any, None, None]:
    params, rows, count, memory = residuals
    parts, num_chunks, chunk = _cut(rows, chunk, "edge")
    cotangents, _, _ = _cut(cotangent, chunk, "constant")
    num_remembered = min((len(kept) - 1 for kept in jax.tree.leaves(memory)), default=math.inf)

    def body(index: jax.Array, gradient: Any) -> Any:
        part = take(parts, index)
        remembered = take(memory, index)
        if num_remembered < num_chunks:
            remembered = jax.lax.cond(
                index < num_remembered, lambda: remembered, lambda: fn(params, part, None)[1]
            )
        _, pullback = jax.vjp(lambda p: fn(p, part, remembered)[0], params)
        return jax.tree.map(jnp.add, gradient, *pullback(take(cotangents, index)))

    zero = jax.tree.map(jnp.zeros_like, params)
    return jax.lax.fori_loop(0, _num_chunks(count, chunk), body, zero), None, None


map_rows.defvjp(_map_rows_forward, _map_rows_backward)


@jax.custom_jvp
def recall(value: jax.Array, remembered: jax.Array) -> jax.Array:
    """Returns `remembered` for the equal `value`, which is differentiated but not computed."""
    return remembered


@recall.defjvp
def _(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    return primals[1], tangents[0]


@jax.custom_batching.custom_vmap
def shared_maximum(x: jax.Array) -> jax.Array:
    """Returns the maximum of a scalar over all vmapped axes, unbatched.

    Loops that all run as long as the longest need no selects between batch elements.
    """
    return x


@shared_maximum.def_vmap
def _(axis_size: int, in_batched: list[bool], x: jax.Array) -> tuple[jax.Array, bool]:
    return shared_maximum(jnp.max(x)), False


def _num_chunks(count: jax.Array, chunk: int) -> jax.Array:
    return shared_maximum((count + chunk - 1) // chunk)


def _cut(rows: Any, chunk: int, padding: Literal["edge", "constant"]) -> tuple[Any, int, int]:
    """Cuts arrays [M, ...] into [num_chunks, chunk, ...], padded with the last row or zeros.

    A row of zeros, which no state shows, may have no derivative: even times 0, that is NaN.

    Also returns num_chunks, and chunk, which is M if there are fewer rows.
    """
    num_rows = len(jax.tree.leaves(rows)[0])
    chunk = min(chunk, num_rows)
    num_chunks = -(-num_rows // chunk)

    def cut(x: jax.Array) -> jax.Array:
        width = [(0, num_chunks * chunk - num_rows)] + [(0, 0)] * (x.ndim - 1)
        x = jnp.pad(x, width, mode=padding)
        return x.reshape(num_chunks, chunk, *x.shape[1:])

    return jax.tree.map(cut, rows), num_chunks, chunk


def _put(table: Any, index: jax.Array, rows: Any) -> Any:
    return jax.tree.map(lambda x, new: x.at[index].set(new), table, rows)


def _table(length: int, shapes: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.zeros((length, *leaf.shape), leaf.dtype), shapes)
