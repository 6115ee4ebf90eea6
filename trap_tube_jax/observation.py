"""Observations for agents, and text pictures for people.

Source: environment.md, "Board and objects".
"""

import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.geometry import COLUMNS, ROWS, bar_cells
from trap_tube_jax.objects import AGENT, BOARD_SIZE, FOOD, NUM_OBJECTS, OBJECT_CHARS, TOOL
from trap_tube_jax.state import State, check_state


def visible_objects(state: State) -> jax.Array:
    """Returns the topmost object of every cell: u8[12, 12] of object codes 0 to 7.

    Raises:
      ValueError: `state` is not one unbatched state.

    Example:
      >>> objects = tt.visible_objects(tt.base_state())
      >>> objects[5, 4:8].tolist()  # trap, food, ground, exit
      [1, 5, 0, 2]
    """
    check_state(state)
    tool = bar_cells(state.tool, state.tool_extent)
    objects = jnp.where(_at(state.food), jnp.uint8(FOOD), state.board)
    objects = jnp.where(tool, jnp.uint8(TOOL), objects)
    return jnp.where(_at(state.agent), jnp.uint8(AGENT), objects)


def observe(state: State) -> jax.Array:
    """Returns the features u8[12, 12, N] of the topmost object of every cell. Pure.

    Raises:
      ValueError: `state` is not one unbatched state.

    Example:
      >>> observation = tt.observe(tt.base_state())
      >>> observation.shape, observation[9, 1].tolist()  # the agent's colour
      ((12, 12, 3), [113, 57, 208])
    """
    objects = visible_objects(state)[..., None]
    # A chain of selects vectorises on a CPU, where a gather runs element by element.
    features = jnp.broadcast_to(state.palette[0], (BOARD_SIZE, BOARD_SIZE, state.palette.shape[1]))
    for code in range(1, NUM_OBJECTS):
        features = jnp.where(objects == code, state.palette[code], features)
    return features


def render_ascii(state: State) -> str:
    """Draws the board as 12 lines of 12 characters, as `State.from_ascii` reads. Runs on the host.

    A character shows the topmost object of its cell alone, so not every state can be read back.

    Raises:
      ValueError: `state` is not one unbatched state.

    Example:
      >>> tt.render_ascii(tt.base_state()).splitlines()[5]
      '.T..xF.e....'
    """
    objects = np.asarray(visible_objects(state))
    return "\n".join("".join(OBJECT_CHARS[code] for code in row) for row in objects)


def _at(cell: jax.Array) -> jax.Array:
    """Returns the mask bool[12, 12] of one cell i32[2]."""
    return (cell[0] == ROWS) & (cell[1] == COLUMNS)
