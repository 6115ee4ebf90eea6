"""Cells, directions and bars on the board, as array functions."""

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.objects import BOARD_SIZE, DOWN, LEFT, RIGHT, UP

# i32[12, 12, 2]: every cell's own (row, column).
CELLS = np.moveaxis(np.indices((BOARD_SIZE, BOARD_SIZE), np.int32), 0, -1)


def unit_vector(direction: jax.Array) -> jax.Array:
    """i32[2] (row, column) displacement of a direction; zero for any other number."""
    row = (direction == DOWN).astype(jnp.int32) - (direction == UP)
    column = (direction == RIGHT).astype(jnp.int32) - (direction == LEFT)
    return jnp.stack([row, column])


def cell_of(index: jax.Array) -> jax.Array:
    """i32[2]: the (row, column) of a flat index in reading order."""
    return jnp.stack([index // BOARD_SIZE, index % BOARD_SIZE]).astype(jnp.int32)


def bar_covers(corner: jax.Array, extent: jax.Array, cell: jax.Array) -> jax.Array:
    """bool[]: whether a cell lies in the bar at `corner` of size `extent`, each i32[2]."""
    return jnp.all((cell >= corner) & (cell < corner + extent))


def bar_cells(corner: jax.Array, extent: jax.Array) -> jax.Array:
    """bool[12, 12]: the cells of the bar at `corner` of size `extent`, each i32[2]."""
    return jnp.all((corner <= CELLS) & (corner + extent > CELLS), axis=-1)
