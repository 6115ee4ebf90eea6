"""Cells, directions and bars on the board, as array functions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.objects import BOARD_SIZE, DOWN, LEFT, RIGHT, UP

# Row i32[12, 1] and column i32[1, 12] of every cell; they broadcast to the board.
ROWS, COLUMNS = np.ogrid[0:BOARD_SIZE, 0:BOARD_SIZE]
ROWS = ROWS.astype(np.int32)
COLUMNS = COLUMNS.astype(np.int32)


def unit_vector(direction: jax.Array | int) -> jax.Array:
    """Returns the displacement i32[2] = (row, column) of a direction, zero for other numbers."""
    direction = jnp.asarray(direction)
    up, down, left, right = (
        (direction == code).astype(jnp.int32) for code in (UP, DOWN, LEFT, RIGHT)
    )
    return jnp.stack([down - up, right - left])


def cell_of(index: jax.Array) -> jax.Array:
    """Returns the cell i32[2] = (row, column) of a flat index in reading order."""
    return jnp.stack([index // BOARD_SIZE, index % BOARD_SIZE]).astype(jnp.int32)


def cell_index(cell: Any) -> Any:
    """Returns the flat indices i32[...] in reading order of cells integer[..., 2].

    NumPy arrays give NumPy arrays.
    """
    cell = cell.astype(np.int32)
    return cell[..., 0] * BOARD_SIZE + cell[..., 1]


def is_on_board(cell: jax.Array) -> jax.Array:
    """Tests whether a cell i32[2] is on the board."""
    return (cell[0] >= 0) & (cell[0] < BOARD_SIZE) & (cell[1] >= 0) & (cell[1] < BOARD_SIZE)


def same_cell(cell: jax.Array, other: jax.Array) -> jax.Array:
    """Tests whether two cells i32[2] are equal."""
    return (cell[0] == other[0]) & (cell[1] == other[1])


def bar_covers(corner: Any, extent: Any, cell: Any) -> Any:
    """Tests whether cells i32[..., 2] are in bars at `corner` of size `extent`, i32[..., 2] each.

    NumPy arrays give NumPy arrays.
    """
    inside = (cell >= corner) & (cell < corner + extent)
    return inside[..., 0] & inside[..., 1]


def bar_cells(corner: jax.Array, extent: jax.Array) -> jax.Array:
    """Returns the mask bool[12, 12] of the bar at `corner` i32[2] of size `extent` i32[2]."""
    end = corner + extent
    in_rows = (corner[0] <= ROWS) & (end[0] > ROWS)
    in_columns = (corner[1] <= COLUMNS) & (end[1] > COLUMNS)
    return in_rows & in_columns
