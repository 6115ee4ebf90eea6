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

from agents.networks.grouping import hash_rows
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
    num_features = observation.shape[-1]
    color = hash_rows(observation)
    own_colors = hash_rows(base_state(num_features).palette)
    anchors = [color == own_colors[thing] for thing in (AGENT, FOOD)]

    lines = _objects(color, left=~(anchors[0] | anchors[1]))
    rows, columns = _shadows(lines)
    agent, food = (_shadows(_pack(anchor)) for anchor in anchors)
    places = [_unpack(shadow, BOARD_SIZE) for shadow in (*agent, *food)]
    places += [_seen_from(*both) for both in zip(food, agent, strict=True)]
    parts = [_unpack(rows, BOARD_SIZE), _unpack(columns, BOARD_SIZE)]
    for anchor in (agent, food):
        row, column = (shadow[:, None] for shadow in anchor)
        parts += [_seen_from(rows, row), _seen_from(columns, column), _around(lines, row, column)]
    size = jnp.sum(jax.lax.population_count(lines), axis=-1)
    parts += [size[..., None] == jnp.arange(NAMED_SIZES + 1, dtype=size.dtype)[None, None]]
    parts += [jnp.stack([size / 20, jnp.log1p(size) / 3], axis=-1)]
    features, places = (
        jnp.concatenate([x.astype(jnp.float32) for x in flags], axis=-1)
        for flags in (parts, places)
    )
    return features, size > 0, places


# Sets of places in a row are the bits of one integer: they shift, join and count fast, where
# arrays of flags take gathers and reductions, which do not vectorise.


def _objects(color: jax.Array, left: jax.Array) -> jax.Array:
    """The cells of up to six colours u32[M, 12, 12], of those that are left, bool[M, 12, 12].

    Returns:
      u32[M, 6, 12], the columns of each of them in every row.
    """
    count = len(color)
    color, left = color.reshape(count, -1), left.reshape(count, -1)
    cells = np.arange(color.shape[1])[None]
    objects = []
    for _ in range(MAX_OBJECTS):
        first = jnp.min(jnp.where(left, cells, color.shape[1] - 1), axis=1, keepdims=True)
        is_same = left & (color == jnp.take_along_axis(color, first, axis=1))
        left = left & ~is_same
        objects.append(_pack(is_same.reshape(count, BOARD_SIZE, BOARD_SIZE)))
    return jnp.stack(objects, axis=1)


def _shadows(lines: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The rows and the columns u32[...] in which u32[..., 12] has cells."""
    columns = jax.lax.reduce(lines, np.uint32(0), jax.lax.bitwise_or, (lines.ndim - 1,))
    return _pack(lines != 0), columns


def _seen_from(places: jax.Array, origin: jax.Array) -> jax.Array:
    """`places` u32[...] as seen from the first of `origin` u32[...], which is in the middle.

    Returns:
      bool[..., 23]; all false where there is no origin.
    """
    reach = BOARD_SIZE - 1
    seen = (places << reach) >> _first(origin)
    return _unpack(jnp.where(origin != 0, seen, 0), 2 * reach + 1)


def _around(lines: jax.Array, row: jax.Array, column: jax.Array) -> jax.Array:
    """The cells of u32[M, K, 12] near the first row and column of u32[M, 1] each.

    Returns:
      bool[M, K, 25], the 5x5 cells around it; all false where there is none, and off the board.
    """
    width = 2 * NEAR + 1
    offset = np.arange(BOARD_SIZE)[None] - _first(row).astype(jnp.int32) + NEAR
    is_near = offset[:, None] == np.arange(width)[None, :, None]
    near = jnp.where(is_near[:, None], lines[:, :, None], 0)
    near = jnp.sum(near, axis=-1, dtype=jnp.uint32)
    cells = (near << NEAR) >> _first(column)[..., None]
    cells = _unpack(jnp.where(row[..., None] != 0, cells, 0), width)
    return cells.reshape(*cells.shape[:2], -1)


def _first(places: jax.Array) -> jax.Array:
    """The lowest place u32[...] of `places` u32[...]; at most 31."""
    return jnp.minimum(jax.lax.population_count((places & -places) - 1), 31)


def _pack(flags: jax.Array) -> jax.Array:
    """Flags bool[..., 12] as the bits of u32[...]."""
    weights = (1 << np.arange(BOARD_SIZE, dtype=np.uint32)).reshape((1,) * (flags.ndim - 1) + (-1,))
    return jnp.sum(jnp.where(flags, weights, 0), axis=-1, dtype=jnp.uint32)


def _unpack(bits: jax.Array, count: int) -> jax.Array:
    """The lowest bits of u32[...] as flags bool[..., count]."""
    places = np.arange(count, dtype=np.uint32).reshape((1,) * bits.ndim + (-1,))
    return (bits[..., None] >> places) & 1 == 1
