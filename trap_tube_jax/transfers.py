"""The transfers: PRNG-driven maps from states to states, and their composition.

A transfer is any pure function `(key, state) -> state`. The three of the paper are
`perceptual` (another layout), `structural` (other features) and `symbolic` (the tool
swaps its looks with another object).

Source: paper sections 3.1.1 to 3.1.3, specification section 5.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from trap_tube_jax.geometry import COLUMNS, ROWS, bar_cells, cell_of
from trap_tube_jax.objects import (
    BOARD_SIZE,
    EXIT,
    GROUND,
    MAX_TOOL_LENGTH,
    TOOL,
    TRAP,
    TUBE1,
    TUBE2,
)
from trap_tube_jax.state import State

Transfer = Callable[[jax.Array, State], State]

SYMBOLIC_OBJECTS = np.array([TOOL, TUBE1, TUBE2, TRAP, EXIT], np.int32)
TUBE_SIDES = (3, 4)  # shortest and longest height and width of the tube
CENTER_FIRST, CENTER_LAST = 4, 8  # rows and columns of the central block, both included
# bool[12, 12]: the cells outside the central block.
AROUND_CENTER = ~(
    ((ROWS >= CENTER_FIRST) & (ROWS <= CENTER_LAST))
    & ((COLUMNS >= CENTER_FIRST) & (COLUMNS <= CENTER_LAST))
)


def compose(*transfers: Transfer) -> Transfer:
    """The transfer that applies `transfers` from left to right, each with its own key.

    Raises:
      ValueError: one of them is not callable.
    """
    for transfer in transfers:
        if not callable(transfer):
            raise ValueError(
                f"a transfer is a function (key, state) -> state, got {transfer!r}; "
                "allowed: trap_tube_jax.perceptual, structural, symbolic or your own"
            )

    def composed(key: jax.Array, state: State) -> State:
        for index, transfer in enumerate(transfers):
            state = transfer(jax.random.fold_in(key, index), state)
        return state

    return composed


def perceptual(key: jax.Array, state: State) -> State:
    """F_P: resamples tube, openings, food, tool and agent; keeps the palette.

    Every choice is uniform over what specification section 5 leaves to it.

    Args:
      key: PRNG key.
      state: one unbatched state; only its palette, time and flags are kept.

    Returns:
      A state with a new layout.
    """
    outline_key, board_key, food_key, bar_key, agent_key = jax.random.split(key, 5)
    outline = _sample_outline(outline_key)
    tool, extent, candidates = _sample_tool(bar_key, outline)
    return state.replace(
        board=_sample_board(board_key, outline),
        food=_uniform_cell(food_key, outline.inside(margin=-1)),
        tool=tool,
        tool_extent=extent,
        agent=_uniform_cell(agent_key, ~candidates & ~bar_cells(tool, extent) & AROUND_CENTER),
    )


def structural(key: jax.Array, state: State) -> State:
    """F_St: resamples the features of tool, tubes, trap, exit and ground.

    Five independent points u, uniform on the unit sphere in N dimensions, become
    features floor((u + 1) / 2 * 255). Both tubes share a point; agent and food keep
    their features. N is the palette's.

    Args:
      key: PRNG key.
      state: one unbatched state.

    Returns:
      The state with a new palette.
    """
    num_features = state.palette.shape[-1]
    normal = jax.random.normal(key, (5, num_features))
    # On the line a quotient in float32 could miss -1 and 1, which are all there is.
    length = jnp.linalg.norm(normal, axis=-1, keepdims=True)
    points = normal / length if num_features > 1 else jnp.sign(normal)
    features = jnp.floor((points + 1) / 2 * 255).astype(jnp.uint8)
    categories = np.array([TOOL, TUBE1, TUBE2, TRAP, EXIT, GROUND])
    points_of = np.array([0, 1, 1, 2, 3, 4])
    return state.replace(palette=state.palette.at[categories].set(features[points_of]))


def symbolic(key: jax.Array, state: State) -> State:
    """F_Sy: swaps shape, place and colour of the tool with those of a random object.

    The object is uniform over tool, tube1, tube2, trap and exit. The new tool starts at
    the object's top-left cell, has as many cells, and is horizontal if the first two in
    reading order share a row; the object takes the old tool's cells. "Tool" changes
    nothing. On boards of one's own, neither does an object that could not be a tool:
    one with no cell, more than four, or a bar that would leave the board.

    Args:
      key: PRNG key.
      state: one unbatched state.

    Returns:
      The state after the swap.
    """
    choice = jax.random.randint(key, (), 0, len(SYMBOLIC_OBJECTS))
    return swap_with_tool(state, jnp.asarray(SYMBOLIC_OBJECTS)[choice])


def swap_with_tool(state: State, code: jax.Array) -> State:
    """The symbolic swap for a given object.

    Args:
      state: one unbatched state.
      code: i32[], one of `SYMBOLIC_OBJECTS`.
    """
    flat = state.board.reshape(-1) == code
    length = jnp.sum(flat, dtype=jnp.int32)
    first = jnp.argmax(flat).astype(jnp.int32)
    second = jnp.argmax(flat & (jnp.arange(flat.size) != first)).astype(jnp.int32)
    corner = cell_of(first)
    horizontal = (length > 1) & (second // BOARD_SIZE == first // BOARD_SIZE)
    extent = jnp.where(horizontal, jnp.stack([1, length]), jnp.stack([length, 1]))

    swaps = (length >= 1) & (length <= MAX_TOOL_LENGTH) & jnp.all(corner + extent <= BOARD_SIZE)
    old_tool = bar_cells(state.tool, state.tool_extent)
    board = jnp.where(state.board == code, jnp.uint8(GROUND), state.board)
    board = jnp.where(old_tool, code.astype(jnp.uint8), board)
    colors = state.palette[jnp.stack([code, jnp.int32(TOOL)])]
    palette = state.palette.at[jnp.stack([jnp.int32(TOOL), code])].set(colors)
    return state.replace(
        board=jnp.where(swaps, board, state.board),
        palette=jnp.where(swaps, palette, state.palette),
        tool=jnp.where(swaps, corner, state.tool),
        tool_extent=jnp.where(swaps, extent, state.tool_extent),
    )


class _Outline(struct.PyTreeNode):
    """The tube's bounding box.

    Attributes:
      corner: i32[2], its top-left cell.
      size: i32[2], its (height, width).
    """

    corner: jax.Array
    size: jax.Array

    def inside(self, margin: int = 0) -> jax.Array:
        """bool[12, 12]: the cells of the box grown by `margin` on each side."""
        return bar_cells(self.corner - margin, self.size + 2 * margin)


def _sample_outline(key: jax.Array) -> _Outline:
    size_key, corner_key = jax.random.split(key)
    size = jax.random.randint(size_key, (2,), TUBE_SIDES[0], TUBE_SIDES[1] + 1)
    corner = jax.random.randint(corner_key, (2,), CENTER_FIRST, CENTER_LAST - size + 1)
    return _Outline(corner, size)


def _sample_board(key: jax.Array, outline: _Outline) -> jax.Array:
    """u8[12, 12]: two tubes on opposite sides, trap and exit in the other two, less corners."""
    axis, swap_openings, swap_tubes = jax.random.bernoulli(key, shape=(3,))
    # (depth, breadth) counts along and across the openings' axis, which is west-east or
    # north-south; the openings are the first and last cells along it, the tubes across it.
    row, column = ROWS - outline.corner[0], COLUMNS - outline.corner[1]
    breadth, depth = jnp.where(axis, row, column), jnp.where(axis, column, row)
    last = jnp.where(axis, outline.size, outline.size[::-1]) - 1
    tube = (breadth == 0) | (breadth == last[0])
    opening = (depth == 0) | (depth == last[1])
    tube_code = jnp.where((breadth == 0) ^ swap_tubes, TUBE1, TUBE2)
    opening_code = jnp.where((depth == 0) ^ swap_openings, TRAP, EXIT)
    board = jnp.where(tube, tube_code, jnp.where(opening, opening_code, GROUND))
    return jnp.where(outline.inside(), board, GROUND).astype(jnp.uint8)


def _sample_tool(key: jax.Array, outline: _Outline) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The tool's corner i32[2] and extent i32[2], and its candidate corners bool[12, 12]."""
    direction_key, corner_key = jax.random.split(key)
    along = jnp.where(
        jax.random.bernoulli(direction_key), np.array([1, 0], np.int32), np.array([0, 1], np.int32)
    )
    length = jnp.sum(outline.size * along)
    # Along itself the bar must end before the last row or column, and start `length` before
    # the tube or behind it; across, it keeps two cells away.
    corners = BOARD_SIZE - length * along
    fits = (corners[0] > ROWS) & (corners[1] > COLUMNS)
    before = jnp.where(along == 1, length, 2)
    behind = jnp.where(along == 1, 0, 2)
    near = bar_cells(outline.corner - before, outline.size + before + behind)
    candidates = fits & ~near
    extent = jnp.where(along == 1, length, 1)
    return _uniform_cell(corner_key, candidates), extent, candidates


def _uniform_cell(key: jax.Array, allowed: jax.Array) -> jax.Array:
    """i32[2]: a cell drawn uniformly from those true in `allowed` bool[12, 12], not empty."""
    rank = jnp.cumsum(allowed.reshape(-1), dtype=jnp.int32)
    chosen = jnp.argmax(rank > jax.random.randint(key, (), 0, rank[-1]))
    return cell_of(chosen)
