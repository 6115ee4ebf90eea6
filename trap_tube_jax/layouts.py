"""Every layout of the perceptual transfer, enumerated once as tables.

The layouts are few, so NumPy enumerates them cell by cell. A draw is then a few integers and as
many look-ups. Counting cells within a draw is an order of magnitude slower under vmap on a CPU.

Source: environment.md, "Perceptual".
"""

import functools
import itertools
from typing import NamedTuple

import numpy as np

from trap_tube_jax.geometry import COLUMNS, ROWS
from trap_tube_jax.objects import BOARD_SIZE, EXIT, GROUND, TRAP, TUBE1, TUBE2

CENTER_FIRST = 4
CENTER_LAST = 8
NUM_OUTLINES = 32
NUM_ASSIGNMENTS = 8

# (length of a side of the tube, its first row or column), equally likely: the length is
# uniform over 3 and 4, then the first row is uniform over the rows that keep the side in 4 to 8.
_SIDES = ((3, 4), (3, 5), (4, 4), (4, 4))


class LayoutTables(NamedTuple):
    """The outcomes of every choice, equally likely within a choice.

    An outline is the rectangle of a tube with a direction of the tool; an assignment says which
    sides are tube1, tube2, trap and exit. Cells are flat indices 0 to 143. Rows of cells end in
    padding; the counts exclude it.

    Attributes:
      layout: i32[L, 2], the pairs (outline, assignment) to draw from.
      board: u8[32, 8, 144], the static objects per outline and assignment.
      food: u8[32, F], the cells inside the tube, then padding.
      num_food: u32[32], how many cells there are.
      extent: i32[32, 2], the tool's (rows, columns).
      tool: u8[32, T], the candidates of the tool's top-left cell, then padding.
      num_tools: u32[32], how many candidates there are.
      agent: u8[32, T, A], the agent's cells by candidate of the tool, then padding.
      num_agents: u32[32, T], how many cells there are; 1 in the padding.
    """

    layout: np.ndarray
    board: np.ndarray
    food: np.ndarray
    num_food: np.ndarray
    extent: np.ndarray
    tool: np.ndarray
    num_tools: np.ndarray
    agent: np.ndarray
    num_agents: np.ndarray


@functools.cache
def layout_tables() -> LayoutTables:
    """Builds the tables of all layouts, once per process."""
    outlines = [
        (height, width, top, left, vertical)
        for (height, top), (width, left) in itertools.product(_SIDES, _SIDES)
        for vertical in (True, False)
    ]
    tools = [_tool_corners(*outline) for outline in outlines]
    agents = [
        [
            _agent_cells(corners, _extent(*outline), int(corner))
            for corner in np.flatnonzero(corners)
        ]
        for outline, corners in zip(outlines, tools, strict=True)
    ]
    tool, num_tools = pad_rows([np.flatnonzero(corners) for corners in tools])
    agent, num_agents = padded_by_outline(agents, len(tool[0]))
    food, num_food = pad_rows([_food_cells(*outline[:4]) for outline in outlines])
    index = np.arange(NUM_OUTLINES * NUM_ASSIGNMENTS, dtype=np.int32)
    return LayoutTables(
        layout=np.stack([index % NUM_OUTLINES, index // NUM_OUTLINES], axis=1),
        board=np.stack([_boards(*outline[:4]) for outline in outlines]),
        food=food,
        num_food=num_food,
        extent=np.array([_extent(*outline) for outline in outlines], np.int32),
        tool=tool,
        num_tools=num_tools,
        agent=agent,
        num_agents=num_agents,
    )


def _box(top: int, left: int, bottom: int, right: int) -> np.ndarray:
    """Returns the mask bool[12, 12] of rows `top` to `bottom`, columns `left` to `right`."""
    return ((top <= ROWS) & (bottom >= ROWS)) & ((left <= COLUMNS) & (right >= COLUMNS))


def _boards(height: int, width: int, top: int, left: int) -> np.ndarray:
    """Draws u8[8, 144]: tubes on two opposite sides, the openings within the other two."""
    bottom = top + height - 1
    right = left + width - 1
    rows = _box(top, left, top, right), _box(bottom, left, bottom, right)
    columns = _box(top, left, bottom, left), _box(top, right, bottom, right)
    boards = []
    for tubes, openings in ((rows, columns), (columns, rows)):
        for trap, exit in (openings, openings[::-1]):
            for tube1, tube2 in (tubes, tubes[::-1]):
                board = np.full((BOARD_SIZE, BOARD_SIZE), GROUND, np.uint8)
                # The tubes keep the corners, so they are laid last.
                for cells, code in ((trap, TRAP), (exit, EXIT), (tube1, TUBE1), (tube2, TUBE2)):
                    board[cells] = code
                boards.append(board.reshape(-1))
    return np.stack(boards)


def _food_cells(height: int, width: int, top: int, left: int) -> np.ndarray:
    """Lists the 1, 2 or 4 cells inside the tube."""
    return np.flatnonzero(_box(top + 1, left + 1, top + height - 2, left + width - 2))


def _extent(height: int, width: int, top: int, left: int, vertical: bool) -> tuple[int, int]:
    return (height, 1) if vertical else (1, width)


def _tool_corners(height: int, width: int, top: int, left: int, vertical: bool) -> np.ndarray:
    """Returns the mask bool[12, 12] of candidates of the tool's top-left cell."""
    if vertical:
        fits = _box(0, 0, BOARD_SIZE - 1 - height, BOARD_SIZE - 1)
        return fits & ~_box(top - height, left - 2, top + height - 1, left + width + 1)
    fits = _box(0, 0, BOARD_SIZE - 1, BOARD_SIZE - 1 - width)
    return fits & ~_box(top - 2, left - width, top + height + 1, left + width - 1)


def _agent_cells(tool_corners: np.ndarray, extent: tuple[int, int], corner: int) -> np.ndarray:
    """Lists the agent's cells for a tool whose top-left cell is the flat index `corner`."""
    row, column = divmod(corner, BOARD_SIZE)
    center = _box(CENTER_FIRST, CENTER_FIRST, CENTER_LAST, CENTER_LAST)
    tool = _box(row, column, row + extent[0] - 1, column + extent[1] - 1)
    return np.flatnonzero(~center & ~tool_corners & ~tool)


def pad_rows(rows: list[np.ndarray], num_rows: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Pads rows of cells to a table u8; also returns their lengths u32, 1 for a missing row."""
    num_rows = num_rows or len(rows)
    table = np.zeros((num_rows, max(map(len, rows))), np.uint8)
    lengths = np.ones(num_rows, np.uint32)
    for index, row in enumerate(rows):
        table[index, : len(row)] = row
        lengths[index] = len(row)
    return table, lengths


def padded_by_outline(
    outlines: list[list[np.ndarray]], num_rows: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pads the rows of every outline to u8[F, num_rows, A], with lengths u32[F, num_rows]."""
    tables, lengths = zip(*(pad_rows(rows, num_rows) for rows in outlines), strict=True)
    longest = max(table.shape[1] for table in tables)
    wide = [np.pad(table, ((0, 0), (0, longest - table.shape[1]))) for table in tables]
    return np.stack(wide), np.stack(lengths)
