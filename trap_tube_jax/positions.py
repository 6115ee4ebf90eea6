"""Numbers for the position of agent, tool and food.

Board, palette and the tool's size do not change within an episode, so the task and this number
determine the state, apart from time and flags.
"""

import jax

from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.state import State

NUM_CELLS = BOARD_SIZE**2
NUM_POSITIONS = NUM_CELLS**3


def position_id(state: State) -> jax.Array:
    """Returns the number i32[], 0 to 144^3 - 1, of a state's position.

    (agent * 144 + tool) * 144 + food, each a cell in reading order; the tool's is its top-left
    one. A state of NumPy arrays gives a NumPy number.
    """
    cells = (state.agent, state.tool, state.food)
    agent, tool, food = (cell[0] * BOARD_SIZE + cell[1] for cell in cells)
    return (agent * NUM_CELLS + tool) * NUM_CELLS + food
