"""The paper's encoder: one observation to 64 features.

Source: paper, section "Results"; agents/agent.md, "Network".
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from agents.networks.convolution import Conv, max_pool
from trap_tube_jax.objects import BOARD_SIZE


class Encoder(nn.Module):
    """Two convolutions, two residual blocks, each after a max pool, and a global max pool.

    Batched, as convolutions are. Every convolution pads to keep the size.

    Attributes:
      filters: channels of the first convolution, and of all later ones.
    """

    filters: tuple[int, int]

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Encodes u8[M, 12, 12, N] to f32[M, filters[1]]."""
        first, later = self.filters
        x = scaled_with_coordinates(observation)
        x = nn.swish(Conv(first, 2, name="conv1")(x))
        x = nn.swish(Conv(later, 2, name="conv2")(x))
        x = max_pool(x)
        x = ResidualBlock(later, name="block1")(x)
        x = max_pool(x)
        x = ResidualBlock(later, name="block2")(x)
        return jnp.max(x, axis=(1, 2))


class ResidualBlock(nn.Module):
    """x + conv3x3(swish(conv3x3(swish(x)))), channels kept.

    Attributes:
      channels: C.
    """

    channels: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps f32[M, H, W, C] to f32[M, H, W, C]."""
        y = Conv(self.channels, 3, name="conv1")(nn.swish(x))
        return x + Conv(self.channels, 3, name="conv2")(nn.swish(y))


def scaled_with_coordinates(observation: jax.Array) -> jax.Array:
    """u8[M, 12, 12, N] to f32[M, 12, 12, N + 3], all in [-1, 1].

    The channels after the N features are column, row and their Euclidean norm, each
    divided by its maximum and rescaled.
    """
    coordinates = jnp.asarray(coordinates_of_cells())
    shape = (*observation.shape[:-1], coordinates.shape[-1])
    return jnp.concatenate([scaled(observation), jnp.broadcast_to(coordinates, shape)], axis=-1)


def scaled(observation: jax.Array) -> jax.Array:
    """u8[...] to f32[...] in [-1, 1]."""
    return observation.astype(jnp.float32) / 127.5 - 1


def coordinates_of_cells() -> np.ndarray:
    """f32[12, 12, 3]: column, row and their norm at every cell, all in [-1, 1]."""
    row, column = np.indices((BOARD_SIZE, BOARD_SIZE)) / (BOARD_SIZE - 1)
    radius = np.hypot(row, column)
    coordinates = 2 * np.stack([column, row, radius / radius.max()], axis=-1) - 1
    return coordinates.astype(np.float32)
