"""An encoder that sees a board as a handful of objects, wherever they are and whatever colour.

An object is all cells of one colour. Agent and food are recognised by their colours, which no
transfer changes. Every other object is described by its place, on the board and as seen from the
agent and from the food, and by its size. Its colour is left out: where every task has new colours,
they say nothing about it.

The description is computed from the observation alone. A small network reads it at a fraction of
the cost of convolutions over 144 cells.

Source: own; objects share a network and are pooled after Zaheer et al. (2017).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from agents.networks.layers import dense
from trap_tube_jax.objects import AGENT, BOARD_SIZE, FOOD, NUM_OBJECTS
from trap_tube_jax.state import base_state

MAX_OBJECTS = NUM_OBJECTS - 2
NAMED_SIZES = 4  # cells; sizes up to here have an input of their own
NEAR = 2  # rows and columns about agent and food, of which every cell is told
NOWHERE = -1e3  # below every activation


class ObjectEncoder(nn.Module):
    """Observation to features: every object by itself, then in view of all, pooled.

    Attributes:
      filters: units of the layers before the objects know of each other, and after.
    """

    filters: tuple[int, int]

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Encodes u8[M, 12, 12, N] to f32[M, 2 * filters[1]]."""
        before, after = self.filters
        x, exists, places = describe_board(observation)
        exists = exists[..., None]
        x = nn.swish(
            dense(before, name="object1")(x) + dense(before, name="places")(places)[:, None]
        )
        x = nn.swish(dense(before, name="object2")(x))
        scene = jnp.max(jnp.where(exists, x, NOWHERE), axis=1)
        x = nn.swish(dense(after, name="object3")(x) + dense(after, name="scene")(scene)[:, None])
        x = nn.swish(dense(after, name="object4")(x))
        largest = jnp.max(jnp.where(exists, x, NOWHERE), axis=1)
        total = jnp.sum(jnp.where(exists, x, 0.0), axis=1)
        return jnp.concatenate([largest, total / MAX_OBJECTS], axis=-1)


def describe_board(observation: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The objects on boards u8[M, 12, 12, N], in the reading order of their first cells.

    Up to `MAX_OBJECTS` are described, which is as many as there are beside agent and food;
    any further ones are left out.

    Returns:
      f32[M, 6, 173]: the rows and the columns in which an object has cells, 12 + 12 flags; the
      same as seen from the agent, 23 + 23, and which of the 5x5 cells around it are the
      object's, 25; the same three for the food; all 0 where agent or food is not to be seen;
      whether the object has 0, 1, 2, 3, 4 cells; and its size, as it is and its logarithm.
      bool[M, 6]: whether there is such an object. f32[M, 94]: row and column of
      the agent, 12 + 12, of the food, 12 + 12, and of the food as seen from the agent, 23 + 23.
    """
    count, _, _, num_features = observation.shape
    weights = np.random.default_rng(0).integers(1, 2**32, num_features, np.uint32)
    color = _hash_colors(observation, weights)
    own_colors = _hash_colors(base_state(num_features).palette, weights)
    anchors = [color == own_colors[thing] for thing in (AGENT, FOOD)]

    left = ~(anchors[0] | anchors[1])
    masks = []
    for _ in range(MAX_OBJECTS):
        first = jnp.argmax(left.reshape(count, -1), axis=1)
        its_color = jnp.take_along_axis(color.reshape(count, -1), first[:, None], axis=1)
        mask = left & (color == its_color[..., None])
        left = left & ~mask
        masks.append(mask)
    mask = jnp.stack(masks, axis=1)

    agent, food = ((jnp.any(anchor, axis=2), jnp.any(anchor, axis=1)) for anchor in anchors)
    offsets = [
        _seen_from(place[:, None], origin)[:, 0] for place, origin in zip(food, agent, strict=True)
    ]
    places = jnp.concatenate([*agent, *food, *offsets], axis=1)
    rows, columns = jnp.any(mask, axis=3), jnp.any(mask, axis=2)
    size = jnp.sum(mask, axis=(2, 3))
    parts = [rows, columns]
    for row, column in (agent, food):
        parts += [_seen_from(rows, row), _seen_from(columns, column), _around(mask, row, column)]
    parts += [size[..., None] == jnp.arange(NAMED_SIZES + 1)[None, None]]
    sizes = jnp.stack([size / 20, jnp.log1p(size) / 3], axis=-1)
    parts = [part.astype(jnp.float32) for part in [*parts, sizes]]
    return jnp.concatenate(parts, axis=-1), size > 0, places.astype(jnp.float32)


def _seen_from(flags: jax.Array, anchor: jax.Array) -> jax.Array:
    """Shifts flags bool[M, K, 12] so that the first place of anchor bool[M, 12] is in the middle.

    Returns:
      bool[M, K, 23]; all false where there is no anchor.
    """
    reach = BOARD_SIZE - 1
    there = jnp.any(anchor, axis=1)[:, None, None]
    padded = jnp.pad(flags & there, ((0, 0), (0, 0), (reach, reach)))
    shape = (flags.shape[1], 2 * reach + 1)

    def around(padded: jax.Array, place: jax.Array) -> jax.Array:
        return jax.lax.dynamic_slice(padded, (0, place), shape)

    return jax.vmap(around)(padded, jnp.argmax(anchor, axis=1))


def _around(mask: jax.Array, row: jax.Array, column: jax.Array) -> jax.Array:
    """The cells of masks bool[M, K, 12, 12] near the one at row and column, bool[M, 12] each.

    Returns:
      bool[M, K, 25], the 5x5 cells around it; all false where there is none, and off the board.
    """
    there = jnp.any(row, axis=1)[:, None, None, None]
    padded = jnp.pad(mask & there, ((0, 0), (0, 0), (NEAR, NEAR), (NEAR, NEAR)))
    width = 2 * NEAR + 1
    shape = (mask.shape[1], width, width)

    def cut(padded: jax.Array, row: jax.Array, column: jax.Array) -> jax.Array:
        return jax.lax.dynamic_slice(padded, (0, row, column), shape).reshape(shape[0], -1)

    return jax.vmap(cut)(padded, jnp.argmax(row, axis=1), jnp.argmax(column, axis=1))


def _hash_colors(colors: jax.Array, weights: np.ndarray) -> jax.Array:
    """u8[..., N] to u32[...], different for different colours but for rare collisions."""
    weights = weights.reshape((1,) * (colors.ndim - 1) + (-1,))
    return jnp.sum(colors.astype(jnp.uint32) * weights, axis=-1, dtype=jnp.uint32)
