"""Identity of layouts and positions.

Board, palette and the tool's extent do not change within an episode, so these and the position of
agent, tool and food determine the state, apart from time and flags.
"""

import jax
import jax.numpy as jnp

from trap_tube_jax.geometry import cell_index
from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.state import State

NUM_CELLS = BOARD_SIZE**2
NUM_POSITIONS = NUM_CELLS**3


def layout_rows(states: State) -> jax.Array:
    """Returns rows u8[B, K], equal only for equal boards, palettes and tool extents. Batched."""
    return _rows(states.board, states.palette, states.tool_extent)


def colorless_rows(states: State) -> jax.Array:
    """Returns rows u8[B, K], equal only for states that are equal but for palette, time and flags.

    Batched.
    """
    bars = (states.tool, states.tool_extent)
    return _rows(states.board, *bars, states.agent, states.food)


def _rows(*fields: jax.Array) -> jax.Array:
    """Joins fields [B, ...] of numbers up to 255."""
    rows = [jnp.asarray(field, jnp.uint8).reshape(len(field), -1) for field in fields]
    return jnp.concatenate(rows, axis=1)


def position_id(state: State) -> jax.Array:
    """Returns the number i32[], 0 to 144^3 - 1, of a state's position.

    (agent * 144 + tool) * 144 + food, cells in reading order; the tool's cell is its top-left one.
    A state of NumPy arrays gives a NumPy number.
    """
    cells = (state.agent, state.tool, state.food)
    agent, tool, food = map(cell_index, cells)
    return (agent * NUM_CELLS + tool) * NUM_CELLS + food
