"""The paper's encoder, and how its first layers are computed once per distinct window.

What the encoder makes of a 2x2 block of the board, up to its first pooling, is a function of
a 4x4 window of the observation. Observations are 36 windows each, and few of them differ: what
one step moves is seen by a handful of windows, and all others are those of the step before.
So a batch of observations is cut into windows, and each distinct one goes through the first
two convolutions once, and then through the third, which is linear, as far as to say what it
adds to each of the cells around. Summing that up, and all that follows, is done observation by
observation.

The result is that of `Encoder` applied as a whole, and so is the gradient, up to the order of
float32 sums. Tests hold both against it.

Source: paper section "Results", agent specification "Network".
"""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from agents.networks import distinct
from agents.networks.core import as_row, hidden_init
from trap_tube_jax.objects import BOARD_SIZE

WINDOW = 4  # cells a side, of which the first pooling sees one 2x2 block of features
BLOCKS = BOARD_SIZE // 2
WINDOW_CHUNK = 128  # distinct windows that are encoded at once; changes speed, not results


class Encoder(nn.Module):
    """Observation to features: two convolutions, two residual blocks, global max pool.

    Batched, as convolutions are. Every convolution pads to keep the size; a 2x2 one
    pads below and to the right.

    Attributes:
      filters: channels of the first convolution, and of all later ones.
    """

    filters: tuple[int, int]

    def setup(self) -> None:
        """Declares the layers."""
        self.conv1 = Conv(self.filters[0], 2)
        self.conv2 = Conv(self.filters[1], 2)
        self.block1 = ResidualBlock(self.filters[1])
        self.block2 = ResidualBlock(self.filters[1])

    def __call__(self, observation: jax.Array) -> jax.Array:
        """Encodes u8[M, 12, 12, N] to f32[M, filters[1]]."""
        x = nn.swish(self.conv1(scaled_with_coordinates(observation)))
        x = max_pool(nn.swish(self.conv2(x)))
        x = self.block2(max_pool(self.block1(x)))
        return jnp.max(x, axis=(1, 2))

    def encode_windows(self, window: jax.Array, block: jax.Array) -> tuple[jax.Array, jax.Array]:
        """What the first pooling yields at single 2x2 blocks of the board.

        Args:
          window: u8[W, 4, 4, N], the part of an observation that starts at the block; what it
            holds beyond the board's edge is ignored.
          block: integer[W], which of the 36 blocks, row by row.

        Returns:
          f32[W, filters[1]]; and f32[W, 9 * filters[1]], see `ResidualBlock.spread`.
        """
        place = jnp.asarray(_coordinates_of_windows())[block]
        coordinates, inside = place[..., :-1], place[..., -1:]
        x = jnp.concatenate([_scaled(window) * inside, coordinates], axis=-1)
        # The second convolution pads its own input, so features beyond the edge are zeros too.
        x = nn.swish(self.conv1(x, pad=False)) * inside[:, :-1, :-1]
        x = jnp.max(nn.swish(self.conv2(x, pad=False)), axis=(1, 2))
        return x, self.block1.spread(x)

    def encode_blocks(self, x: jax.Array, spread: jax.Array) -> jax.Array:
        """What follows: both results of `encode_windows`, [M, 6, 6, ...], to f32[M, filters[1]]."""
        x = self.block2(max_pool(self.block1.collect(x, spread)))
        return jnp.max(x, axis=(1, 2))


class ResidualBlock(nn.Module):
    """x + conv3x3(swish(conv3x3(swish(x)))), channels kept.

    Attributes:
      channels: C.
    """

    channels: int

    def setup(self) -> None:
        """Declares the two convolutions."""
        self.conv1 = Conv(self.channels, 3)
        self.conv2 = Conv(self.channels, 3)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps f32[M, H, W, C] to f32[M, H, W, C]."""
        return x + self.conv2(nn.swish(self.conv1(nn.swish(x))))

    def spread(self, x: jax.Array) -> jax.Array:
        """What cells f32[W, C] add to the first convolution at each of the 9 cells around them.

        Returns:
          f32[W, 9 * C], row by row.
        """
        return self.conv1.spread(nn.swish(x))

    def collect(self, x: jax.Array, spread: jax.Array) -> jax.Array:
        """The block's result from f32[M, H, W, C] and f32[M, H, W, 9 * C]."""
        return x + self.conv2(nn.swish(self.conv1.collect(spread)))


class Conv(nn.Module):
    """A square convolution of stride 1, written as one matrix product.

    XLA's CPU convolutions are slow backwards; the product of the gathered patches with
    the kernel, [M * H * W, k * k * C_in] times [k * k * C_in, C_out], is not.

    Attributes:
      features: output channels.
      size: k, the kernel's height and width.
    """

    features: int
    size: int

    @nn.compact
    def __call__(self, x: jax.Array, *, pad: bool = True) -> jax.Array:
        """Maps f32[M, H, W, C_in] to f32[M, H, W, features], or to less by k - 1 unpadded."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", hidden_init, shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        y: Any = convolve(x, kernel) if pad else patches(x, self.size) @ as_matrix(kernel)
        return self._remember(y + as_row(bias, x.ndim))

    def spread(self, x: jax.Array) -> jax.Array:
        """What cells f32[W, C_in] add to each of the cells around, f32[W, k * k * features]."""
        kernel = self.get_variable("params", "kernel")[::-1, ::-1]
        return x @ kernel.transpose(2, 0, 1, 3).reshape(x.shape[-1], -1)

    def collect(self, spread: jax.Array) -> jax.Array:
        """The convolution from f32[M, H, W, k * k * features], what `spread` says of its input."""
        bias = self.get_variable("params", "bias")
        sums: Any = add_patches(spread, self.size)
        return self._remember(sums + as_row(bias, spread.ndim))

    def _remember(self, y: jax.Array) -> jax.Array:
        """Lets y be remembered, and recalls it if it was; see `distinct.recall`."""
        if self.has_variable("remembered", "y"):
            y = distinct.recall(y, self.get_variable("remembered", "y"))
        if not self.is_initializing():
            self.sow("remembered", "y", y, init_fn=lambda: y, reduce_fn=lambda _, y: y)
        return y


def encode_by_windows(
    encoder: Encoder, params: Any, observation: jax.Array, remembered: Any = None
) -> tuple[jax.Array, Any]:
    """`encoder.apply(params, observation)`, its first layers once per distinct window.

    Args:
      encoder: the encoder.
      params: its parameters.
      observation: u8[M, 12, 12, N].
      remembered: None, or what an earlier call with the same arguments returned beside the
        features; its matrix products are then not computed again.

    Returns:
      f32[M, filters[1]], not differentiable with respect to the observation; and the results
      of all matrix products that are made observation by observation.
    """
    window, block = cut_into_windows(observation)
    groups = distinct.group_rows(jnp.concatenate([window, block[:, None]], axis=1))
    window, block = window[groups.representative], block[groups.representative]

    def encode(params: Any, rows: Any, _: None) -> tuple[Any, None]:
        return encoder.apply(params, *rows, method="encode_windows"), None

    features = distinct.map_rows(
        encode,
        WINDOW_CHUNK,
        params,
        (window.reshape(-1, WINDOW, WINDOW, observation.shape[-1]), block),
        groups.total,
    )
    shape = (len(observation), BLOCKS, BLOCKS, -1)
    x, spread = (table[groups.number].reshape(shape) for table in features)
    if remembered is not None:
        x = distinct.recall(x, remembered["x"])
        params = {**params, "remembered": remembered["layers"]}
    y: Any
    y, variables = encoder.apply(params, x, spread, method="encode_blocks", mutable=["remembered"])
    return y, {"x": x, "layers": variables["remembered"]}


def cut_into_windows(observation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The 36 windows of every observation u8[M, 12, 12, N].

    Returns:
      u8[36 * M, 4 * 4 * N], zeros beyond the board's edge; and u8[36 * M], the block that each
      starts at, from 0 to 35, row by row.
    """
    count = len(observation)
    beyond = WINDOW - 2
    padded = jnp.pad(observation, ((0, 0), (0, beyond), (0, beyond), (0, 0)))
    cells = [
        padded[:, i : i + BOARD_SIZE : 2, j : j + BOARD_SIZE : 2]
        for i in range(WINDOW)
        for j in range(WINDOW)
    ]
    block = jnp.arange(BLOCKS**2, dtype=jnp.uint8)
    return (
        jnp.stack(cells, axis=3).reshape(count * BLOCKS**2, -1),
        jnp.broadcast_to(block, (count, BLOCKS**2)).reshape(-1),
    )


def scaled_with_coordinates(observation: jax.Array) -> jax.Array:
    """u8[M, 12, 12, N] to f32[M, 12, 12, N + 3], all in [-1, 1].

    The channels after the N features are column, row and their Euclidean norm, each
    divided by its maximum and rescaled.
    """
    coordinates = jnp.asarray(_coordinates())
    shape = (*observation.shape[:-1], coordinates.shape[-1])
    return jnp.concatenate([_scaled(observation), jnp.broadcast_to(coordinates, shape)], axis=-1)


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


def _scaled(observation: jax.Array) -> jax.Array:
    """u8[...] to f32[...] in [-1, 1]."""
    return observation.astype(jnp.float32) / 127.5 - 1


def _coordinates() -> np.ndarray:
    """f32[12, 12, 3]: column, row and their norm at every cell."""
    row, column = np.indices((BOARD_SIZE, BOARD_SIZE)) / (BOARD_SIZE - 1)
    radius = np.hypot(row, column)
    coordinates = 2 * np.stack([column, row, radius / radius.max()], axis=-1) - 1
    return coordinates.astype(np.float32)


def _coordinates_of_windows() -> np.ndarray:
    """f32[36, 4, 4, 4]: of every window's cells the coordinates and a 1; zeros beyond the edge."""
    inside = np.ones((BOARD_SIZE, BOARD_SIZE, 1), np.float32)
    beyond = (0, WINDOW - 2)
    board = np.pad(np.concatenate([_coordinates(), inside], axis=-1), (beyond, beyond, (0, 0)))
    starts = range(0, BOARD_SIZE, 2)
    return np.stack([board[i : i + WINDOW, j : j + WINDOW] for i in starts for j in starts])
