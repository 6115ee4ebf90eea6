"""An encoder that treats the board as objects, wherever they are and whatever their colours.

An object is all cells of one colour. Agent and food are known by their colours, which no transfer
changes. Every other object is described by its cells, on the board and relative to agent and food,
and by its size. Colours say nothing if every task draws new ones. Where some tasks keep them, flags
can tell which object of the base task has the same colour.

The description depends only on the observation. A small network reads this description at a
fraction of the cost of convolutions over 144 cells.

Source: this project; objects share a network and are pooled after Zaheer et al. (2017).
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents.networks.hashing import hash_rows
from agents.networks.layers import dense
from trap_tube_jax.objects import AGENT, BOARD_SIZE, FOOD, NUM_OBJECTS

MAX_OBJECTS = NUM_OBJECTS - 2
NAMED_SIZES = 4  # cells; every size up to here is an input
NEAR = 2  # rows and columns about agent and food, of which every cell is an input
NOWHERE = -1e3  # below every activation


class ObjectEncoder(nn.Module):
    """Encodes each object by itself, then in the context of the scene, and pools over objects.

    Layers before the objects are pooled into a scene have `filters[0]` units, later ones
    `filters[1]`.

    Attributes:
      filters: units of the layers before and after pooling.
      knows_colors: also describes each object by the colours of the base task.
    """

    filters: tuple[int, int]
    knows_colors: bool = False

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Encodes u8[M, 12, 12, N] to f32[M, 2 * filters[1]]."""
        before, after = self.filters
        board = describe_board(observation)
        x = board.features
        exists = board.exists[..., None]
        if self.knows_colors:
            x = jnp.concatenate([x, board.looks_like.astype(jnp.float32)], axis=-1)
        positions = dense(before, name="places")(board.positions)
        x = nn.swish(dense(before, name="object1")(x) + positions[:, None])
        x = nn.swish(dense(before, name="object2")(x))
        scene = jnp.max(jnp.where(exists, x, NOWHERE), axis=1)
        x = nn.swish(dense(after, name="object3")(x) + dense(after, name="scene")(scene)[:, None])
        x = nn.swish(dense(after, name="object4")(x))
        largest = jnp.max(jnp.where(exists, x, NOWHERE), axis=1)
        total = jnp.sum(jnp.where(exists, x, 0.0), axis=1)
        return jnp.concatenate([largest, total / MAX_OBJECTS], axis=-1)


class Board(NamedTuple):
    """Description of M boards.

    Attributes:
      features: f32[M, 6, 173], by object: flags of the rows and columns that the object occupies,
        12 + 12; flags of the same rows and columns relative to the agent, 23 + 23, and of the
        object's cells in the 5x5 square around the agent, 25; the same three for the food; flags
        of the sizes 0 to 4; size / 20 and log(1 + size) / 3. Flags relative to an invisible agent
        or food are 0.
      looks_like: bool[M, 6, 8], by object: whether it has the colour of object code k in the base
        task.
      exists: bool[M, 6], whether there is such an object.
      positions: f32[M, 94]: flags of the agent's row and column, 12 + 12, the food's, 12 + 12, and
        the food's relative to the agent, 23 + 23.
    """

    features: jax.Array
    looks_like: jax.Array
    exists: jax.Array
    positions: jax.Array


def describe_board(observation: jax.Array) -> Board:
    """Describes objects on boards u8[M, 12, 12, N], in the reading order of their first cells.

    At most 6 objects besides agent and food are described; any further ones are left out.
    """
    color = hash_rows(observation)
    base_colors = hash_rows(jnp.asarray(tt.base_palette(observation.shape[-1])))
    anchors = [color == base_colors[code] for code in (AGENT, FOOD)]
    lines, object_colors = _objects(color, left=~(anchors[0] | anchors[1]))
    rows, columns = _project(lines)
    agent, food = (_project(_pack(anchor)) for anchor in anchors)
    positions = [_unpack(bits, BOARD_SIZE) for bits in (*agent, *food)]
    positions += [_relative(*both) for both in zip(food, agent, strict=True)]
    parts = [_unpack(rows, BOARD_SIZE), _unpack(columns, BOARD_SIZE)]
    for anchor in (agent, food):
        row, column = (bits[:, None] for bits in anchor)
        parts += [_relative(rows, row), _relative(columns, column), _around(lines, row, column)]
    size = jnp.sum(jax.lax.population_count(lines), axis=-1, dtype=jnp.uint32)
    parts += [size[..., None] == np.arange(NAMED_SIZES + 1, dtype=np.uint32)[None, None]]
    size = size.astype(jnp.float32)
    parts += [jnp.stack([size / 20, jnp.log1p(size) / 3], axis=-1)]
    features, positions = (
        jnp.concatenate([x.astype(jnp.float32) for x in flags], axis=-1)
        for flags in (parts, positions)
    )
    looks_like = object_colors[..., None] == base_colors[None, None]
    return Board(features, looks_like, size > 0, positions)


# Positions in a row or column are the bits of one integer. Integers are fast to shift, merge and
# count; arrays of flags need gathers and reductions, which do not vectorise.


def _objects(color: jax.Array, left: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the columns u32[M, 6, 12], row by row, of the first six colours in u32[M, 12, 12].

    Considers only the cells flagged in `left`, bool[M, 12, 12]. Also returns these colours,
    u32[M, 6].
    """
    count = len(color)
    color = color.reshape(count, -1)
    left = left.reshape(count, -1)
    cells = np.arange(color.shape[1], dtype=np.int32)[None]
    objects = []
    colors = []
    for _ in range(MAX_OBJECTS):
        first = jnp.min(jnp.where(left, cells, cells[0, -1]), axis=1, keepdims=True)
        colors.append(jnp.take_along_axis(color, first, axis=1))
        is_same = left & (color == colors[-1])
        left = left & ~is_same
        objects.append(_pack(is_same.reshape(count, BOARD_SIZE, BOARD_SIZE)))
    return jnp.stack(objects, axis=1), jnp.concatenate(colors, axis=1)


def _project(lines: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the rows and the columns u32[...] in which u32[..., 12] has cells."""
    columns = jax.lax.reduce(lines, np.uint32(0), jax.lax.bitwise_or, (lines.ndim - 1,))
    return _pack(lines != 0), columns


def _relative(positions: jax.Array, origin: jax.Array) -> jax.Array:
    """Returns flags bool[..., 23] of positions u32[...] about an origin; false where it is 0."""
    reach = BOARD_SIZE - 1
    seen = (positions << np.uint32(reach)) >> _first(origin)
    return _unpack(jnp.where(origin != 0, seen, 0), 2 * reach + 1)


def _around(lines: jax.Array, row: jax.Array, column: jax.Array) -> jax.Array:
    """Returns flags bool[M, K, 25] of cells u32[M, K, 12] around a row and column u32[M, 1].

    They are false off the board, and where the row is 0.
    """
    width = 2 * NEAR + 1
    offset = np.arange(BOARD_SIZE, dtype=np.int32)[None] - _first(row).astype(jnp.int32) + NEAR
    is_near = offset[:, None] == np.arange(width, dtype=np.int32)[None, :, None]
    near = jnp.sum(jnp.where(is_near[:, None], lines[:, :, None], 0), axis=-1, dtype=jnp.uint32)
    cells = (near << np.uint32(NEAR)) >> _first(column)[..., None]
    cells = _unpack(jnp.where(row[..., None] != 0, cells, 0), width)
    return cells.reshape(*cells.shape[:2], -1)


def _first(positions: jax.Array) -> jax.Array:
    """Returns the lowest position u32[...] of `positions` u32[...]; at most 31."""
    return jnp.minimum(jax.lax.population_count((positions & -positions) - 1), 31)


def _pack(flags: jax.Array) -> jax.Array:
    """Packs flags bool[..., 12] into the bits of u32[...]."""
    weights = (1 << np.arange(BOARD_SIZE, dtype=np.uint32)).reshape((1,) * (flags.ndim - 1) + (-1,))
    return jnp.sum(jnp.where(flags, weights, 0), axis=-1, dtype=jnp.uint32)


def _unpack(bits: jax.Array, count: int) -> jax.Array:
    """Unpacks the lowest bits of u32[...] into flags bool[..., count]."""
    positions = np.arange(count, dtype=np.uint32).reshape((1,) * bits.ndim + (-1,))
    return (bits[..., None] >> positions) & 1 == 1
