"""A function of rows, computed chunk by chunk for as many rows as there are, with a derivative.

The encoder is a function of the observation alone, takes nearly all of the time, and observations
repeat. So distinct observations are put first, and only those are encoded: in chunks of fixed
size, whose number depends on the data. Loops of varying length have no derivative in JAX;
`map_rows` brings its own, and remembers for it what is costly to compute.
"""

import functools
import math
from typing import Any, Protocol

import jax
import jax.numpy as jnp

REMEMBERED_BYTES = 2**26  # by one `map_rows`; changes speed and nothing else


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


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def map_rows(fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array) -> Any:
    """`fn` on the first `count` rows, a chunk at a time; zeros below.

    Differentiable with respect to `params` only. What `fn` wants remembered is, as far as
    `REMEMBERED_BYTES` go; for the rows after that, the derivative calls it once more.

    Args:
      fn: see `RowFn`.
      chunk: rows per call of `fn`; M where there are fewer.
      params: any pytree.
      rows: pytree of arrays [M, ...].
      count: i32[], at most M.

    Returns:
      The features, a pytree of arrays [M, ...].
    """
    return _map_rows_forward(fn, chunk, params, rows, count)[0]


def _map_rows_forward(
    fn: RowFn, chunk: int, params: Any, rows: Any, count: jax.Array
) -> tuple[Any, Any]:
    num_rows = len(jax.tree.leaves(rows)[0])
    chunk = min(chunk, num_rows)
    padded = _pad_rows(rows, chunk)
    num_chunks = len(jax.tree.leaves(padded)[0]) // chunk
    shapes = jax.eval_shape(fn, params, _take(padded, 0, chunk), None)
    num_bytes = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes[1]))
    num_remembered = min(REMEMBERED_BYTES // max(num_bytes, 1), num_chunks)

    def body(index: jax.Array, outputs: tuple[Any, Any]) -> tuple[Any, Any]:
        features, memory = fn(params, _take(padded, index, chunk), None)
        place = jnp.minimum(index, num_remembered)  # one more place, for all that are not kept
        return _put(outputs[0], index, features), _put(outputs[1], place, memory)

    outputs = _zeros(num_chunks, shapes[0]), _zeros(num_remembered + 1, shapes[1])
    features, memory = jax.lax.fori_loop(0, _num_chunks(count, chunk), body, outputs)
    features = jax.tree.map(lambda x: jax.lax.collapse(x, 0, 2)[:num_rows], features)
    return features, (params, rows, count, memory)


def _map_rows_backward(
    fn: RowFn, chunk: int, residuals: Any, cotangent: Any
) -> tuple[Any, None, None]:
    params, rows, count, memory = residuals
    chunk = min(chunk, len(jax.tree.leaves(rows)[0]))
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


map_rows.defvjp(_map_rows_forward, _map_rows_backward)


@jax.custom_jvp
def recall(value: jax.Array, remembered: jax.Array) -> jax.Array:
    """`remembered` in place of the equal `value`, which is differentiated but not computed."""
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
    return shared_maximum(jnp.max(x)), False


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


def _put(table: Any, place: jax.Array, rows: Any) -> Any:
    return jax.tree.map(lambda x, new: x.at[place].set(new), table, rows)


def _zeros(length: int, shapes: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.zeros((length, *leaf.shape), leaf.dtype), shapes)
