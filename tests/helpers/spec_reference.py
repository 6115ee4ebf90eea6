"""A second reading of trap_tube_jax/environment.md, in plain NumPy and Python.

Written from the rules alone, for plainness rather than speed, and apart from the package:
it imports nothing of it.
"""

import functools
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

SIZE = 12
OBJECT_NAMES = ("ground", "trap", "exit", "tube1", "tube2", "food", "tool", "agent")
GROUND, TRAP, EXIT, TUBE1, TUBE2, FOOD, TOOL, AGENT = range(8)
OFF_BOARD = 99
DIRECTIONS = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
BASE_COLORS = np.array(
    [
        (72, 65, 17),
        (208, 113, 57),
        (208, 189, 57),
        (57, 152, 208),
        (57, 152, 208),
        (208, 57, 77),
        (152, 208, 57),
        (113, 57, 208),
    ],
    np.uint8,
)


class Cell(NamedTuple):
    """One cell, or as many as the arrays hold."""

    row: Any
    column: Any

    def shifted(self, by: "Cell", times: Any = 1) -> "Cell":
        return Cell(self.row + by.row * times, self.column + by.column * times)

    def same(self, other: "Cell") -> Any:
        return (self.row == other.row) & (self.column == other.column)


class Layouts(NamedTuple):
    """Board [12, 12] and tool size [2], or n of each: [n, 12, 12] and [n, 2]."""

    board: np.ndarray
    extent: np.ndarray

    def static_object(self, cell: Cell) -> np.ndarray:
        """Returns the object of the static layer, `OFF_BOARD` around the board."""
        frame = [(0, 0)] * (self.board.ndim - 2) + [(1, 1), (1, 1)]
        framed = np.pad(self.board, frame, constant_values=OFF_BOARD)
        which = () if self.board.ndim == 2 else (np.arange(len(self.board)),)
        return framed[(*which, cell.row + 1, cell.column + 1)]

    def bar(self, corner: Cell) -> list[Cell]:
        """The four cells of a tool at `corner`; a shorter one repeats its last."""
        rows = self.extent[..., 0]
        columns = self.extent[..., 1]
        along = Cell((rows > 1).astype(int), (columns > 1).astype(int))
        last = np.maximum(rows, columns) - 1
        return [corner.shifted(along, np.minimum(i, last)) for i in range(4)]


class Moved(NamedTuple):
    """Flags of a step: which objects moved by a cell, and success."""

    food: np.ndarray
    tool: np.ndarray
    agent: np.ndarray
    solved: np.ndarray


def is_in(cell: Cell, cells: list[Cell]) -> np.ndarray:
    return functools.reduce(np.logical_or, [cell.same(other) for other in cells])


def choose(condition: np.ndarray, then: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """`np.where` of booleans, which NumPy does several times slower."""
    return (condition & then) | (~condition & otherwise)


def on_board(cell: Cell) -> np.ndarray:
    return (cell.row >= 0) & (cell.row < SIZE) & (cell.column >= 0) & (cell.column < SIZE)


def step(layouts: Layouts, agent: Cell, tool: Cell, food: Cell, action: tuple) -> Moved:
    """Takes a step with an action (grasp, move). All arrays broadcast."""
    grasp, move = action
    d = Cell(*np.moveaxis(DIRECTIONS[move], -1, 0))
    next_to = agent.shifted(Cell(*np.moveaxis(DIRECTIONS[grasp], -1, 0)))
    bar = layouts.bar(tool)
    moved_bar = layouts.bar(tool.shifted(d))
    ahead = agent.shifted(d)
    pushed = food.shifted(d)
    grasped = is_in(next_to, bar) & ~is_in(agent, bar)
    agent_free = layouts.static_object(ahead) == GROUND
    food_ahead = is_in(food.shifted(d, -1), bar) & ~is_in(food, bar)
    food_free = np.isin(layouts.static_object(pushed), (GROUND, EXIT)) & ~is_in(pushed, bar)

    # Small tables first, [agent, tool] or [tool, food]: fewer operations on all three.
    food_moves = (grasped & agent_free) & (food_ahead & food_free)

    stays_on_board = np.all([on_board(cell) for cell in moved_bar], axis=0)
    tool_moves = (grasped & agent_free & stays_on_board) & (~food_ahead | food_moves)
    held = grasped & ~tool_moves

    covered = choose(tool_moves, is_in(ahead, moved_bar), is_in(ahead, bar))
    onto_food = choose(food_moves, ahead.same(pushed), ahead.same(food))
    can_enter = on_board(ahead) & (agent_free | onto_food)
    agent_moves = can_enter & ~(held | covered)

    meet_if_agent_stays = choose(food_moves, agent.same(pushed), agent.same(food))
    solved = choose(agent_moves, onto_food, meet_if_agent_stays)
    return Moved(food_moves, tool_moves, agent_moves, solved)


def visible(board: np.ndarray, agent: Any, tool: Any, extent: Any, food: Any) -> np.ndarray:
    """The topmost object of every cell: later codes hide earlier ones."""
    shown = np.array(board)
    shown[tuple(food)] = FOOD
    for cell in Layouts(board, np.asarray(extent)).bar(Cell(*tool)):
        shown[cell] = TOOL
    shown[tuple(agent)] = AGENT
    return shown


class Outline(NamedTuple):
    """Height, width and top-left corner of the tube."""

    height: int
    width: int
    row: int
    column: int


def outlines() -> dict[Outline, float]:
    """Every outline and its probability."""
    chances = {}
    for height, width in itertools.product((3, 4), (3, 4)):
        corners = list(itertools.product(range(4, 8 - height + 1), range(4, 8 - width + 1)))
        for row, column in corners:
            chances[Outline(height, width, row, column)] = 1 / 4 / len(corners)
    return chances


def boards(outline: Outline) -> Iterator[np.ndarray]:
    """The eight equally likely boards of an outline."""
    top = outline.row
    left = outline.column
    bottom = top + outline.height - 1
    right = left + outline.width - 1
    row_side = [(top, slice(left, right + 1)), (bottom, slice(left, right + 1))]
    column_side = [(slice(top, bottom + 1), left), (slice(top, bottom + 1), right)]
    row_openings = [(row, slice(left + 1, right)) for row in (top, bottom)]
    column_openings = [(slice(top + 1, bottom), column) for column in (left, right)]
    for tubes, openings in ((row_side, column_openings), (column_side, row_openings)):
        for trap, tube1 in itertools.product((0, 1), (0, 1)):
            board = np.full((SIZE, SIZE), GROUND, np.uint8)
            board[openings[trap]] = TRAP
            board[openings[1 - trap]] = EXIT
            board[tubes[tube1]] = TUBE1
            board[tubes[1 - tube1]] = TUBE2
            yield board


def food_cells(outline: Outline) -> list[tuple[int, int]]:
    rows = range(outline.row + 1, outline.row + outline.height - 1)
    columns = range(outline.column + 1, outline.column + outline.width - 1)
    return list(itertools.product(rows, columns))


def tool_cells(outline: Outline, vertical: bool, corner: tuple[int, int]) -> set[tuple[int, int]]:
    row, column = corner
    if vertical:
        return {(row + i, column) for i in range(outline.height)}
    return {(row, column + i) for i in range(outline.width)}


def tool_corners(outline: Outline, vertical: bool) -> list[tuple[int, int]]:
    """The candidates for the tool's top-left cell."""
    h, w, R, C = outline
    if vertical:
        allowed = itertools.product(range(0, 11 - h + 1), range(0, 11 + 1))
        zone = set(itertools.product(range(R - h, R + h), range(C - 2, C + w + 2)))
    else:
        allowed = itertools.product(range(0, 11 + 1), range(0, 11 - w + 1))
        zone = set(itertools.product(range(R - 2, R + h + 2), range(C - w, C + w)))
    return [corner for corner in allowed if corner not in zone]


def agent_cells(outline: Outline, vertical: bool, corner: tuple[int, int]) -> list[tuple[int, int]]:
    central = set(itertools.product(range(4, 9), range(4, 9)))
    refused = central | set(tool_corners(outline, vertical))
    refused |= tool_cells(outline, vertical, corner)
    return [c for c in itertools.product(range(SIZE), range(SIZE)) if c not in refused]


@functools.cache
def placements() -> np.ndarray:
    """[outline, vertical, tool corner, agent cell]: the joint probability of all four.

    Outlines as `outlines()` lists them, cells as flat indices in reading order.
    """
    table = np.zeros((len(outlines()), 2, SIZE * SIZE, SIZE * SIZE))
    for index, (outline, chance) in enumerate(outlines().items()):
        for vertical in (False, True):
            corners = tool_corners(outline, vertical)
            for corner in corners:
                cells = agent_cells(outline, vertical, corner)
                where = (index, int(vertical), flat(corner), [flat(cell) for cell in cells])
                table[where] = chance / 2 / len(corners) / len(cells)
    return table


def flat(cell: tuple[int, int]) -> int:
    return cell[0] * SIZE + cell[1]


class Looks(NamedTuple):
    """The fields of a state that the symbolic transfer changes."""

    board: np.ndarray
    palette: np.ndarray
    tool: np.ndarray
    extent: np.ndarray


def swapped(before: Looks, code: int) -> Looks:
    """The symbolic transfer when it draws the object `code`."""
    if code == TOOL:
        return before
    cells = [tuple(cell) for cell in np.argwhere(before.board == code).tolist()]  # reading order
    length = len(cells)
    horizontal = length > 1 and cells[0][0] == cells[1][0]
    board = before.board.copy()
    palette = before.palette.copy()
    for cell in cells:
        board[cell] = GROUND
    for row in range(before.tool[0], before.tool[0] + before.extent[0]):
        for column in range(before.tool[1], before.tool[1] + before.extent[1]):
            board[row, column] = code
    palette[TOOL], palette[code] = before.palette[code], before.palette[TOOL]
    extent = (1, length) if horizontal else (length, 1)
    return Looks(board, palette, np.array(cells[0]), np.array(extent))


def sphere_feature_chances(num_features: int) -> np.ndarray:
    """[256]: chances of floor((u + 1) / 2 * 255), u one coordinate on the unit sphere.

    With u = -cos(angle) the angle's density is proportional to sin(angle)^(N - 2), which
    is integrated from bin edge to bin edge; for N = 1, u is -1 or 1.
    """
    chances = np.zeros(256)
    if num_features == 1:
        chances[[0, 255]] = 0.5
        return chances
    angles = np.arccos(1 - 2 * np.arange(256) / 255)
    nodes, weights = np.polynomial.legendre.leggauss(16)
    middle = (angles[1:] + angles[:-1]) / 2
    half = (angles[1:] - angles[:-1]) / 2
    samples = np.sin(middle[:, None] + half[:, None] * nodes) ** (num_features - 2)
    chances[:255] = half * (samples @ weights)
    return chances / chances.sum()
