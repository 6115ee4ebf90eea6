"""The transfers: PRNG-driven maps from states to states, and their composition.

A transfer is any pure function `(key, state) -> state`. The three of the paper are
`perceptual` (another layout), `structural` (other features) and `symbolic` (the tool
swaps its looks with another object).

Source: paper, sections "Perceptual", "Structural" and "Symbolic"; environment.md, "Transfers".
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.geometry import bar_cells, bar_covers, cell_of, is_on_board
from trap_tube_jax.layouts import MAX_FOOD_CELLS, NUM_ASSIGNMENTS, NUM_FRAMES, layout_tables
from trap_tube_jax.objects import (
    AGENT,
    BOARD_SIZE,
    EXIT,
    FOOD,
    GROUND,
    MAX_TOOL_LENGTH,
    NUM_OBJECTS,
    TOOL,
    TRAP,
    TUBE1,
    TUBE2,
)
from trap_tube_jax.prng import fold_in, loop_free
from trap_tube_jax.state import State, check_state

Transfer = Callable[[jax.Array, State], State]

SYMBOLIC_OBJECTS = np.array([TOOL, TUBE1, TUBE2, TRAP, EXIT], np.int32)
# Row of the resampled features per object code; agent and food take none.
POINT_OF_OBJECT = np.array([4, 2, 3, 1, 1, 0, 0, 0], np.int32)


def compose(*transfers: Transfer) -> Transfer:
    """The transfer that applies `transfers` from left to right, each with its own key.

    Transfer i gets `jax.random.fold_in(key, i)`, a key of the same type as `key`.

    Raises:
      ValueError: one of them is not callable, or not hashable.
    """
    for transfer in transfers:
        if not callable(transfer):
            raise ValueError(
                f"a transfer is a function (key, state) -> state, got {transfer!r}; "
                "allowed: trap_tube_jax.perceptual, structural, symbolic or your own"
            )
        try:
            hash(transfer)
        except TypeError as error:
            raise ValueError(
                f"a transfer must be hashable, for example a frozen dataclass, got {transfer!r}"
            ) from error

    def composed(key: jax.Array, state: State) -> State:
        for index, transfer in enumerate(transfers):
            state = transfer(fold_in(key, index), state)
            # Without it XLA fuses a draw into each of its uses and repeats it there.
            state = jax.lax.optimization_barrier(state)
        return state

    return composed


def perceptual(key: jax.Array, state: State) -> State:
    """F_P: resamples tube, openings, food, tool and agent; keeps the palette.

    environment.md, "Perceptual", has every choice and its distribution; `layouts` lists the
    outcomes. A number below n is the remainder of 32 random bits, off the uniform
    distribution by less than n / 2**32.

    Args:
      key: PRNG key.
      state: one unbatched state; only its palette, time and flags are kept.

    Returns:
      A state with a new layout.

    Raises:
      ValueError: `state` is not one unbatched state.
    """
    check_state(state)
    tables = jax.tree.map(jnp.asarray, layout_tables())
    layout, food, tool, agent = jax.random.bits(loop_free(key), (4,), jnp.uint32)
    frame, assignment = layout % NUM_FRAMES, layout // NUM_FRAMES % NUM_ASSIGNMENTS
    tool %= tables.num_tools[frame]
    agent %= tables.num_agents[frame, tool]
    return state.replace(
        board=tables.board[frame, assignment].reshape(BOARD_SIZE, BOARD_SIZE),
        food=cell_of(tables.food[frame, food % MAX_FOOD_CELLS]),
        tool=cell_of(tables.tool[frame, tool]),
        tool_extent=tables.extent[frame],
        agent=cell_of(tables.agent[frame, tool, agent]),
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

    Raises:
      ValueError: `state` is not one unbatched state.
    """
    check_state(state)
    return recolor(state, sphere_points(key, state.palette.shape[-1]))


def sphere_points(key: jax.Array, num_features: int) -> jax.Array:
    """f32[8, N]: for every object code the point that `structural` draws, uniform on the sphere.

    The rows of agent and food are not used.
    """
    normal = jax.random.normal(loop_free(key), (5, num_features), jnp.float32)
    points = normal / jnp.linalg.norm(normal, axis=-1, keepdims=True)
    if num_features == 1:  # -1 and 1, which the rounded quotient may miss
        points = jnp.where(normal < 0, -1.0, 1.0)
    return points[POINT_OF_OBJECT]


def recolor(state: State, points: jax.Array) -> State:
    """The state with the features of points f32[8, N], but for agent and food.

    Coordinates beyond -1 or 1 are cut off there.
    """
    features = jnp.floor((points.clip(-1, 1) + 1) / 2 * 255).astype(jnp.uint8)
    keeps = np.isin(np.arange(NUM_OBJECTS), (AGENT, FOOD))[:, None]
    return state.replace(palette=jnp.where(keeps, state.palette, features))


def symbolic(key: jax.Array, state: State) -> State:
    """F_Sy: swaps shape, place and colour of the tool with those of a random object.

    The object is uniform over tool, tube1, tube2, trap and exit. The new tool starts at
    the object's top-left cell, has as many cells, and is horizontal if the first two in
    reading order share a row; the object takes the old tool's cells. "Tool" changes
    nothing. On boards of your own nor does an object that cannot be a tool: one without
    cells, one with more than four, or one whose bar would leave the board; and nothing is
    swapped while the tool covers agent or food, which would then stand on the object.

    Args:
      key: PRNG key.
      state: one unbatched state.

    Returns:
      The state after the swap.

    Raises:
      ValueError: `state` is not one unbatched state.
    """
    check_state(state)
    choice = jax.random.randint(loop_free(key), (), 0, len(SYMBOLIC_OBJECTS), jnp.int32)
    return swap_with_tool(state, jnp.asarray(SYMBOLIC_OBJECTS)[choice])


def swap_with_tool(state: State, code: jax.Array) -> State:
    """The symbolic swap for a given object.

    Args:
      state: one unbatched state.
      code: i32[], one of `SYMBOLIC_OBJECTS`; the tool's own code changes nothing.

    Returns:
      The state after the swap, or as it was; see `symbolic`.
    """
    cells = np.arange(BOARD_SIZE**2, dtype=np.int32)
    is_object = state.board.reshape(-1) == code
    length = jnp.sum(is_object, dtype=jnp.int32)
    first = jnp.min(cells, where=is_object, initial=cells[-1])
    second = jnp.min(cells, where=is_object & (cells > first), initial=cells[-1])
    corner = cell_of(first)
    horizontal = (length > 1) & (second // BOARD_SIZE == first // BOARD_SIZE)
    extent = jnp.where(horizontal, jnp.stack([1, length]), jnp.stack([length, 1]))

    covers = functools.partial(bar_covers, state.tool, state.tool_extent)
    is_clear = ~covers(state.agent) & ~covers(state.food)
    fits = is_on_board(corner + extent - 1)
    swaps = (length >= 1) & (length <= MAX_TOOL_LENGTH) & fits & is_clear
    old_tool = bar_cells(state.tool, state.tool_extent)
    board = jnp.where(state.board == code, jnp.uint8(GROUND), state.board)
    board = jnp.where(old_tool, code.astype(jnp.uint8), board)
    objects = np.arange(NUM_OBJECTS)
    partner = jnp.where(objects == TOOL, code, jnp.where(objects == code, TOOL, objects))
    looks_of = jnp.where(swaps, partner, objects)
    return state.replace(
        board=jnp.where(swaps, board, state.board),
        palette=state.palette[looks_of],
        tool=jnp.where(swaps, corner, state.tool),
        tool_extent=jnp.where(swaps, extent, state.tool_extent),
    )
