"""A faster way to compute the paper's encoder: its first layers once per distinct window.

Up to its first pooling, the encoder turns a 4x4 window of the observation into the features of
one 2x2 block of the board. An observation is 36 windows, and most of them repeat: one step of an
episode changes a handful. So a batch of observations is cut into windows. Each distinct window
goes through the first two convolutions once. The third one is linear, so what a window contributes
to each of the cells around it is computed once, too. Adding these contributions up, and all that
follows, is done observation by observation.

Features and gradient are those of `Encoder`, up to the order of float32 sums; tests compare them.
Nothing but speed depends on this module: `encode_rows` may as well apply any encoder as it is.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from agents.networks import chunks
from agents.networks.convolution import (
    add_patches,
    as_matrix,
    convolve,
    max_pool,
    patches,
)
from agents.networks.encoder import Encoder, coordinates_of_cells, scaled
from agents.networks.grouping import group_rows
from agents.networks.layers import as_row
from trap_tube_jax.objects import BOARD_SIZE

WINDOW = 4  # cells a side, of which the first pooling sees one 2x2 block of features
BLOCKS = BOARD_SIZE // 2
WINDOW_CHUNK = 128  # distinct windows encoded at once; changes speed, and results only by rounding

Weights = Any  # nested dictionaries of arrays: the parameters of `Encoder`, or of a layer in it


def encode_rows(
    encoder: nn.Module, params: Any, observation: jax.Array, remembered: Any = None
) -> tuple[Any, Any]:
    """`encoder.apply(params, observation)`, by windows if it is the paper's encoder.

    A row function of `chunks.map_rows`, which explains the rest.
    """
    if type(encoder) is Encoder:  # one that is derived from it may compute something else
        return encode_by_windows(params, observation, remembered)
    return encoder.apply(params, observation), None


def encode_by_windows(
    params: Any, observation: jax.Array, remembered: Any = None
) -> tuple[jax.Array, Any]:
    """The features of the paper's encoder, its first layers once per distinct window.

    Args:
      params: the parameters of `Encoder`.
      observation: u8[M, 12, 12, N].
      remembered: None, or what an earlier call with the same arguments returned beside the
        features; its matrix products are then not computed again.

    Returns:
      f32[M, filters[1]], not differentiable with respect to the observation; and the results
      of all matrix products that are made observation by observation.
    """
    weights = params["params"]
    window, block = cut_into_windows(observation)
    groups = group_rows(jnp.concatenate([window, block[:, None]], axis=1))
    window, block = window[groups.representative], block[groups.representative]
    window = window.reshape(-1, WINDOW, WINDOW, observation.shape[-1])

    def encode(weights: Weights, rows: Any, _: None) -> tuple[Any, None]:
        return encode_windows(weights, *rows), None

    features: Any = chunks.map_rows(encode, WINDOW_CHUNK, weights, (window, block), groups.total)
    shape = (len(observation), BLOCKS, BLOCKS, -1)
    x, spread = (table[groups.number].reshape(shape) for table in features)
    products = _Products(remembered)
    return encode_blocks(weights, products("x", x), spread, products), products.made


def encode_windows(
    weights: Weights, window: jax.Array, block: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """What the first pooling yields at single 2x2 blocks of the board.

    Args:
      weights: of the encoder.
      window: u8[W, 4, 4, N], the part of an observation that starts at the block; what it
        holds beyond the board's edge is ignored.
      block: integer[W], which of the 36 blocks, row by row.

    Returns:
      f32[W, C]; and f32[W, 9 * C], what each adds to the first convolution of the residual
      block at the 9 cells around it, row by row.
    """
    place = jnp.asarray(_coordinates_of_windows())[block]
    coordinates, inside = place[..., :-1], place[..., -1:]
    x = jnp.concatenate([scaled(window) * inside, coordinates], axis=-1)
    # The second convolution pads its own input, so features beyond the edge are zeros too.
    x = nn.swish(_unpadded(weights["conv1"], x)) * inside[:, :-1, :-1]
    x = jnp.max(nn.swish(_unpadded(weights["conv2"], x)), axis=(1, 2))
    kernel = weights["block1"]["conv1"]["kernel"][::-1, ::-1]
    return x, nn.swish(x) @ kernel.transpose(2, 0, 1, 3).reshape(x.shape[-1], -1)


def encode_blocks(
    weights: Weights, x: jax.Array, spread: jax.Array, products: "_Products"
) -> jax.Array:
    """What follows: both results of `encode_windows`, [M, 6, 6, ...], to f32[M, C]."""
    block1, block2 = weights["block1"], weights["block2"]
    sums: Any = add_patches(spread, len(block1["conv1"]["kernel"]))
    y = products("block1/conv1", sums + as_row(block1["conv1"]["bias"], sums.ndim))
    x = max_pool(x + products("block1/conv2", _padded(block1["conv2"], nn.swish(y))))
    y = products("block2/conv1", _padded(block2["conv1"], nn.swish(x)))
    x = x + products("block2/conv2", _padded(block2["conv2"], nn.swish(y)))
    return jnp.max(x, axis=(1, 2))


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


class _Products:
    """Notes arrays by name as they are made, and recalls those that were made before."""

    def __init__(self, known: dict[str, jax.Array] | None):
        self.known = known
        self.made: dict[str, jax.Array] = {}

    def __call__(self, name: str, value: jax.Array) -> jax.Array:
        if self.known is not None:
            value = chunks.recall(value, self.known[name])
        self.made[name] = value
        return value


def _padded(layer: Weights, x: jax.Array) -> jax.Array:
    """The convolution of f32[M, H, W, C_in] with a layer's weights, of the same size."""
    y: Any = convolve(x, layer["kernel"])
    return y + as_row(layer["bias"], x.ndim)


def _unpadded(layer: Weights, x: jax.Array) -> jax.Array:
    """The same without padding, so smaller by k - 1."""
    kernel = layer["kernel"]
    return patches(x, len(kernel)) @ as_matrix(kernel) + as_row(layer["bias"], x.ndim)


def _coordinates_of_windows() -> np.ndarray:
    """f32[36, 4, 4, 4]: of every window's cells the coordinates and a 1; zeros beyond the edge."""
    inside = np.ones((BOARD_SIZE, BOARD_SIZE, 1), np.float32)
    beyond = (0, WINDOW - 2)
    board = np.pad(
        np.concatenate([coordinates_of_cells(), inside], axis=-1), (beyond, beyond, (0, 0))
    )
    starts = range(0, BOARD_SIZE, 2)
    return np.stack([board[i : i + WINDOW, j : j + WINDOW] for i in starts for j in starts])
