"""Rules of one step: food, tool, agent, task, in that order.

Source: paper, section "Trap-Tube Environments"; environment.md, "One step".
"""

import functools

import jax
import jax.numpy as jnp

from trap_tube_jax.geometry import bar_covers, is_on_board, same_cell, unit_vector
from trap_tube_jax.objects import BOARD_SIZE, EXIT, GROUND
from trap_tube_jax.state import State


def step(state: State, action: jax.Array) -> State:
    """Moves food, tool and agent by one action and marks success.

    Pure, deterministic, and defined for every state, also with the agent on the tool. A state
    that is done does not change. Time and the step limit belong to the environment.

    Args:
      state: one unbatched state.
      action: integer[2] = (grasp, move), each 0 up, 1 down, 2 left, 3 right. Any other number
        grasps nothing or moves nowhere.

    Returns:
      The state after the step; `terminated` is set when agent and food share a cell.
    """
    board = state.board
    agent = state.agent
    food = state.food
    tool = state.tool
    extent = state.tool_extent
    on_tool = functools.partial(bar_covers, tool, extent)
    move = jnp.where(state.done, 0, unit_vector(action[1]))

    grasped = holds_tool(state, action[0])
    agent_free = static_object(board, agent + move) == GROUND
    food_ahead = on_tool(food - move) & ~on_tool(food)
    beyond_food = static_object(board, food + move)
    food_free = ((beyond_food == GROUND) | (beyond_food == EXIT)) & ~on_tool(food + move)

    food_moves = grasped & agent_free & food_ahead & food_free
    new_food = jnp.where(food_moves, food + move, food)

    tool_fits = is_on_board(tool + move) & is_on_board(tool + move + extent - 1)
    tool_moves = grasped & agent_free & (~food_ahead | food_moves) & tool_fits
    new_tool = jnp.where(tool_moves, tool + move, tool)

    held = grasped & ~tool_moves
    reaches_food = same_cell(agent + move, new_food)
    blocked_by_tool = bar_covers(new_tool, extent, agent + move)
    agent_moves = ~held & ~blocked_by_tool & (agent_free | reaches_food)
    new_agent = jnp.where(agent_moves, agent + move, agent)

    return state.replace(
        agent=new_agent,
        tool=new_tool,
        food=new_food,
        terminated=state.terminated | same_cell(new_agent, new_food),
    )


def replay(state: State, actions: jax.typing.ArrayLike) -> State:
    """Returns the T + 1 states of an episode, the first included, along a new first axis.

    Unbatched; vmap it.

    Args:
      state: the first state.
      actions: integer[T, 2], (grasp, move). Actions after a solution change nothing.
    """

    def body(state: State, action: jax.Array) -> tuple[State, State]:
        state = step(state, action)
        return state, state

    first = jax.tree.map(jnp.asarray, state)
    _, later = jax.lax.scan(body, first, jnp.asarray(actions))
    return jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), first, later)


def holds_tool(state: State, direction: jax.Array | int) -> jax.Array:
    """Tests whether a grasp holds the tool: the next cell is the tool's, the agent's is not."""
    on_tool = functools.partial(bar_covers, state.tool, state.tool_extent)
    return on_tool(state.agent + unit_vector(direction)) & ~on_tool(state.agent)


def static_object(board: jax.Array, cell: jax.Array) -> jax.Array:
    """Returns the code i32[] of the static object at `cell` i32[2] of u8[12, 12]; -1 off it."""
    row, column = jnp.clip(cell, 0, BOARD_SIZE - 1)
    code = jnp.asarray(board)[row, column]  # NumPy takes no traced indices
    return jnp.where(is_on_board(cell), code.astype(jnp.int32), -1)
