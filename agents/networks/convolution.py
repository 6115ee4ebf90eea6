"""Convolutions as matrix products of patches, and max pooling.

XLA's CPU convolutions are slow backwards; the product of the gathered patches with the kernel,
[M * H * W, k * k * C_in] times [k * k * C_in, C_out], is not.
"""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.networks.layers import as_row, hidden_init


class Conv(nn.Module):
    """A square convolution of stride 1 that keeps the size.

    A kernel of even size pads more below and to the right.

    Attributes:
      features: output channels.
      size: k, the kernel's height and width.
    """

    features: int
    size: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps f32[M, H, W, C_in] to f32[M, H, W, features]."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", hidden_init, shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        return convolve(x, kernel) + as_row(bias, x.ndim)


def patches(x: jax.Array, size: int) -> jax.Array:
    """All square parts: f32[M, H, W, C] to f32[M, H - size + 1, W - size + 1, size * size * C]."""
    height, width = (length - size + 1 for length in x.shape[1:3])
    shifts = [x[:, i : i + height, j : j + width] for i in range(size) for j in range(size)]
    return jnp.concatenate(shifts, axis=-1)


def pad_edges(x: jax.Array, size: int, *, turned: bool = False) -> jax.Array:
    """Zeros around f32[M, H, W, C] that let a convolution of this size keep H and W.

    Turned, where the size is even, they are more above and to the left.
    """
    before = (size - 1) // 2
    padding = (before, size - 1 - before)
    padding = padding[::-1] if turned else padding
    return jnp.pad(x, ((0, 0), padding, padding, (0, 0)))


def as_matrix(kernel: jax.Array) -> jax.Array:
    """f32[k, k, C_in, C_out] to f32[k * k * C_in, C_out], what `patches` are multiplied with."""
    return kernel.reshape(-1, kernel.shape[-1])


@jax.custom_vjp
def convolve(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """f32[M, H, W, C_in] and f32[k, k, C_in, C_out] to f32[M, H, W, C_out], padded with zeros.

    Both derivatives are made from the patches of the cotangent. JAX, left to itself, would add
    up k * k overlapping parts for the one and make the patches of x again for the other.
    """
    size = len(kernel)
    return patches(pad_edges(x, size), size) @ as_matrix(kernel)


def _convolve_backward(residuals: Any, cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = residuals
    size, _, channels, features = kernel.shape
    turned = kernel[::-1, ::-1].swapaxes(2, 3)
    around = patches(pad_edges(cotangent, size, turned=True), size)
    by_kernel = jnp.tensordot(x, around, axes=[(0, 1, 2)] * 2)
    by_kernel = by_kernel.reshape(channels, size, size, features).transpose(1, 2, 0, 3)
    return around @ as_matrix(turned), by_kernel[::-1, ::-1]


convolve.defvjp(lambda x, kernel: (convolve(x, kernel), (x, kernel)), _convolve_backward)


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def add_patches(x: jax.Array, size: int) -> jax.Array:
    """The transpose of `patches` after `pad_edges`, for odd sizes.

    Every cell of f32[M, H, W, size * size * C] holds what it adds to the cells around it, row
    by row; the sums are f32[M, H, W, C]. Its own derivative is `patches`, written as such
    because XLA does not find out.
    """
    channels = x.shape[-1] // size**2
    cells = jax.ShapeDtypeStruct((*x.shape[:-1], channels), x.dtype)
    (sums,) = jax.linear_transpose(lambda y: patches(pad_edges(y, size), size), cells)(x)
    return sums


add_patches.defvjp(
    lambda x, size: (add_patches(x, size), None),
    lambda size, _, cotangent: (patches(pad_edges(cotangent, size), size),),
)


def max_pool(x: jax.Array) -> jax.Array:
    """The maximum over 2x2 blocks: f32[M, H, W, C] to f32[M, H / 2, W / 2, C]."""
    count, height, width, channels = x.shape
    return jnp.max(x.reshape(count, height // 2, 2, width // 2, 2, channels), axis=(2, 4))
