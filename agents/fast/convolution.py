"""Convolutions as matrix products of patches with the kernel.

On a CPU, matrix products are faster than XLA's convolutions, whose derivatives are slow. Results
equal those of Flax's convolutions up to rounding.
"""

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.networks.layers import Conv, as_row


@contextlib.contextmanager
def convolutions_as_products() -> Iterator[None]:
    """Computes every `Conv` of Flax modules as a matrix product."""

    def replace(call: Callable[..., Any], args: Any, kwargs: Any, context: Any) -> Any:
        if type(context.module) is not Conv or context.method_name != "__call__":
            return call(*args, **kwargs)
        (x,) = (*args, *kwargs.values())
        weights = context.module.variables["params"]
        return convolve(x, weights["kernel"]) + as_row(weights["bias"], x.ndim)

    with nn.intercept_methods(replace):
        yield


def patches(x: jax.Array, size: int, stride: int = 1) -> jax.Array:
    """Cuts [M, H, W, C] into squares, [M, H', W', size² * C] with H' = (H - size) // stride + 1."""
    height, width = (length - size + 1 for length in x.shape[1:3])
    starts = [(i, j) for i in range(size) for j in range(size)]
    shifts = [x[:, i : i + height : stride, j : j + width : stride] for i, j in starts]
    return jnp.concatenate(shifts, axis=-1)


def padded_patches(x: jax.Array, size: int, *, turned: bool = False) -> jax.Array:
    """Cuts f32[M, H, W, C], padded with zeros, into f32[M, H, W, size² * C].

    An even size pads more below and to the right or, if turned, above and to the left.
    """
    before = (size - 1) // 2
    padding = (before, size - 1 - before)
    padding = padding[::-1] if turned else padding
    return patches(jnp.pad(x, ((0, 0), padding, padding, (0, 0))), size)


def add_patches(x: jax.Array, size: int) -> jax.Array:
    """Transposes `padded_patches`, for an odd size.

    Every cell of f32[M, H, W, size² * C] holds its contributions to the cells around it, row by
    row; their sums are f32[M, H, W, C].
    """
    zero = jnp.zeros((), x.dtype)
    still = (0, 0, 0)
    # JAX transposes `split` to one concatenation, but slices to a sum of padded arrays.
    parts = jnp.split(x, size**2, axis=-1)
    reach = range(-(size // 2), size // 2 + 1)
    moved = [
        jax.lax.pad(part, zero, [still, (down, -down, 0), (right, -right, 0), still])
        for part, (down, right) in zip(parts, itertools.product(reach, reach), strict=True)
    ]
    return functools.reduce(jnp.add, moved)


@jax.custom_vjp
def convolve(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolves f32[M, H, W, C_in] with f32[k, k, C_in, C_out], padded with zeros, to C_out.

    Both derivatives are matrix products with patches of the cotangent. JAX's derivatives would
    instead add up k * k overlapping parts for `x` and cut the patches of `x` again for `kernel`.
    """
    return padded_patches(x, len(kernel)) @ kernel.reshape(-1, kernel.shape[-1])


def _convolve_backward(residuals: Any, cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = residuals
    size, _, channels, features = kernel.shape
    turned = kernel[::-1, ::-1].swapaxes(2, 3)
    cotangent = jax.lax.optimization_barrier(cotangent)  # else XLA computes it for every shift
    around = padded_patches(cotangent, size, turned=True)
    by_kernel = jnp.tensordot(x, around, axes=[(0, 1, 2)] * 2)
    by_kernel = by_kernel.reshape(channels, size, size, features).transpose(1, 2, 0, 3)
    return around @ turned.reshape(-1, channels), by_kernel[::-1, ::-1]


convolve.defvjp(lambda x, kernel: (convolve(x, kernel), (x, kernel)), _convolve_backward)
