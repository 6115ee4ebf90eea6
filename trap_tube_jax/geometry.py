"""Cells, directions and bars on the board, as array functions."""

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.objects import BOARD_SIZE, DOWN, LEFT, RIGHT, UP

# i32[12, 1] and i32[1, 12]: every cell's own row and column, to be broadcast against each other.
ROWS, COLUMNS = np.ogrid[0:BOARD_SIZE, 0:BOARD_SIZE]
ROWS, COLUMNS = ROWS.astype(np.int32), COLUMNS.astype(np.int32)


def unit_vector(direction: jax.Array | int) -> jax.Array:
    """i32[2] (row, column) displacement of a direction; zero for any other number."""
    direction = jnp.asarray(direction)
    row = (direction == DOWN).astype(jnp.int32) - (direction == UP)
    column = (direction == RIGHT).astype(jnp.int32) - (direction == LEFT)
    return jnp.stack([row, column])


def cell_of(index: jax.Array) -> jax.Array:
    """i32[2]: the (row, column) of a flat index in reading order."""
    return jnp.stack([index // BOARD_SIZE, index % BOARD_SIZE]).astype(jnp.int32)


def is_on_board(cell: jax.Array) -> jax.Array:
    """bool[]: whether a cell i32[2] lies on the board."""
    return (cell[0] >= 0) & (cell[0] < BOARD_SIZE) & (cell[1] >= 0) & (cell[1] < BOARD_SIZE)


def same_cell(cell: jax.Array, other: jax.Array) -> jax.Array:
    """bool[]: whether two cells, each i32[2], are equal."""
    return (cell[0] == other[0]) & (cell[1] == other[1])


def bar_covers(corner: jax.Array, extent: jax.Array, cell: jax.Array) -> jax.Array:
    """bool[]: whether a cell lies in the bar at `corner` of size `extent`, each i32[2]."""
    inside = (cell >= corner) & (cell < corner + extent)
    return inside[0] & inside[1]


def bar_cells(corner: jax.Array, extent: jax.Array) -> jax.Array:
    """bool[12, 12]: the cells of the bar at `corner` of size `extent`, each i32[2]."""
    end = corner + extent
    in_rows = (corner[0] <= ROWS) & (end[0] > ROWS)
    in_columns = (corner[1] <= COLUMNS) & (end[1] > COLUMNS)
    return in_rows & in_columns
