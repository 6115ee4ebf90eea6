"""The paper's encoder: one observation to 64 features.

Source: paper, section "Results"; agents/agent.md, "Network".
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from agents.networks.layers import Conv
from trap_tube_jax.objects import BOARD_SIZE


class Encoder(nn.Module):
    """Two convolutions, two residual blocks, each after a max pool, and a global max pool.

    Takes a batch of observations, as convolutions do. Every convolution pads to keep its input's
    size.

    Attributes:
      filters: channels of the first convolution, and of all later ones.
    """

    filters: tuple[int, int]

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Encodes u8[M, 12, 12, N] to f32[M, filters[1]]."""
        first, later = self.filters
        cells = jnp.asarray(coordinates_of_cells())
        cells = jnp.broadcast_to(cells, (*observation.shape[:-1], cells.shape[-1]))
        x = jnp.concatenate([scaled(observation), cells], axis=-1)
        x = nn.swish(Conv(first, 2, name="conv1")(x))
        x = nn.swish(Conv(later, 2, name="conv2")(x))
        x = max_pool(x)
        x = ResidualBlock(later, name="block1")(x)
        x = max_pool(x)
        x = ResidualBlock(later, name="block2")(x)
        return jnp.max(x, axis=(1, 2))


class ResidualBlock(nn.Module):
    """x + conv3x3(swish(conv3x3(swish(x)))), for `channels` channels."""

    channels: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps f32[M, H, W, C] to f32[M, H, W, C]."""
        y = Conv(self.channels, 3, name="conv1")(nn.swish(x))
        return x + Conv(self.channels, 3, name="conv2")(nn.swish(y))


def scaled(observation: jax.Array) -> jax.Array:
    """Maps u8[...] to f32[...] in [-1, 1]."""
    return observation.astype(jnp.float32) / 127.5 - 1


def coordinates_of_cells() -> np.ndarray:
    """Returns column, row and their Euclidean norm at every cell, f32[12, 12, 3].

    Each is divided by its maximum and rescaled to [-1, 1].
    """
    row, column = np.indices((BOARD_SIZE, BOARD_SIZE)) / (BOARD_SIZE - 1)
    radius = np.hypot(row, column)
    coordinates = 2 * np.stack([column, row, radius / radius.max()], axis=-1) - 1
    return coordinates.astype(np.float32)


def max_pool(x: jax.Array) -> jax.Array:
    """Takes maxima over 2x2 blocks: f32[M, H, W, C] to f32[M, H / 2, W / 2, C]."""
    count, height, width, channels = x.shape
    return jnp.max(x.reshape(count, height // 2, 2, width // 2, 2, channels), axis=(2, 4))
