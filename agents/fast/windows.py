"""Computes `networks.encoder.Encoder`, its first layers once per distinct window.

Up to its first pooling, the encoder maps a 4x4 window of the observation to the features of one 2x2
block of the board. An observation is 36 windows, most of which repeat: one step changes a handful.
So each distinct window of a batch goes through the first two convolutions once. The third
convolution is linear, so each window's contributions to the cells around it are also computed once.
Contributions are added up, and later layers applied, observation by observation.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from agents.fast import chunks
from agents.fast.convolution import add_patches, convolve, patches
from agents.fast.grouping import group_rows
from agents.networks.encoder import coordinates_of_cells, max_pool, scaled
from agents.networks.layers import as_row
from trap_tube_jax.objects import BOARD_SIZE

WINDOW = 4  # height and width of a window, in cells
BLOCKS = BOARD_SIZE // 2
WINDOW_CHUNK = 128  # distinct windows encoded at once; affects results only by rounding

Weights = Any  # nested dictionaries of arrays: the parameters of `Encoder`, or of a layer in it


def encode_rows(params: Any, observation: jax.Array, remembered: Any = None) -> tuple[Any, Any]:
    """Encodes observations u8[M, 12, 12, N] by the parameters of `networks.encoder.Encoder`.

    Returns:
      The features f32[M, F], differentiable only by `params`, and the memory for `chunks.map_rows`:
      results of matrix products.
    """
    weights = params["params"]
    window = cut_into_windows(observation)
    block = jnp.tile(jnp.arange(BLOCKS**2, dtype=jnp.uint8), len(observation))
    groups = group_rows(jnp.concatenate([window.reshape(len(window), -1), block[:, None]], axis=1))
    rows = window[groups.representative], block[groups.representative]

    def encode(weights: Weights, rows: Any, _: None) -> tuple[Any, None]:
        return encode_windows(weights, *rows), None

    features: Any = chunks.map_rows(encode, WINDOW_CHUNK, weights, rows, groups.total)
    shape = (len(observation), BLOCKS, BLOCKS, -1)
    x, spread = (table[groups.group_id].reshape(shape) for table in features)
    return encode_blocks(weights, x, spread, remembered)


def cut_into_windows(board: jax.Array) -> jax.Array:
    """Cuts boards [M, 12, 12, C] into 36 windows each, [36 * M, 4, 4, C], zeros beyond the edge."""
    padded = jnp.pad(board, ((0, 0), (0, WINDOW - 2), (0, WINDOW - 2), (0, 0)))
    return patches(padded, WINDOW, stride=2).reshape(-1, WINDOW, WINDOW, board.shape[-1])


def encode_windows(
    weights: Weights, window: jax.Array, block: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes the layers up to the first pooling, at single 2x2 blocks of the board.

    Args:
      weights: of the encoder.
      window: u8[W, 4, 4, N], of which the part beyond the board's edge is ignored.
      block: integer[W], the block at which the window starts, 0 to 35, row by row.

    Returns:
      f32[W, C], and its contributions f32[W, 9 * C] to the residual block's first convolution at
      the 9 cells around it.
    """
    inside = np.ones((BOARD_SIZE, BOARD_SIZE, 1), np.float32)
    board = np.concatenate([coordinates_of_cells(), inside], axis=-1)
    here = cut_into_windows(jnp.asarray(board[None]))[block]
    coordinates = here[..., :-1]
    inside = here[..., -1:]
    x = jnp.concatenate([scaled(window) * inside, coordinates], axis=-1)
    # The second convolution pads its input, so features beyond the edge are zeros too.
    x = nn.swish(_unpadded(weights["conv1"], x)) * inside[:, :-1, :-1]
    x = jnp.max(nn.swish(_unpadded(weights["conv2"], x)), axis=(1, 2))
    kernel = weights["block1"]["conv1"]["kernel"][::-1, ::-1]
    return x, nn.swish(x) @ kernel.transpose(2, 0, 1, 3).reshape(x.shape[-1], -1)


def encode_blocks(
    weights: Weights, x: jax.Array, spread: jax.Array, remembered: Any
) -> tuple[jax.Array, Any]:
    """Computes f32[M, C] from `encode_windows` [M, 6, 6, ...]; returns matrix products, too."""
    made = {}

    def product(name: str, value: jax.Array) -> jax.Array:
        made[name] = value if remembered is None else chunks.recall(value, remembered[name])
        return made[name]

    block1 = weights["block1"]
    block2 = weights["block2"]
    x = product("x", x)
    y = add_patches(spread, len(block1["conv1"]["kernel"]))
    y = product("block1/conv1", y + as_row(block1["conv1"]["bias"], y.ndim))
    x = max_pool(x + product("block1/conv2", _padded(block1["conv2"], nn.swish(y))))
    y = product("block2/conv1", _padded(block2["conv1"], nn.swish(x)))
    x = x + product("block2/conv2", _padded(block2["conv2"], nn.swish(y)))
    return jnp.max(x, axis=(1, 2)), made


def _padded(layer: Weights, x: jax.Array) -> jax.Array:
    return convolve(x, layer["kernel"]) + as_row(layer["bias"], x.ndim)


def _unpadded(layer: Weights, x: jax.Array) -> jax.Array:
    kernel = layer["kernel"]
    y = patches(x, len(kernel)) @ kernel.reshape(-1, kernel.shape[-1])
    return y + as_row(layer["bias"], x.ndim)
