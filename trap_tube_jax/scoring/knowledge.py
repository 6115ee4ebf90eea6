"""First pushes and first grasps, which show what an agent knew before it tried.

Source: protocol.md, "Knowledge of the trap" and "Search for the tool".
"""

import jax
import jax.numpy as jnp

from trap_tube_jax.dynamics import holds_tool, replay, static_object
from trap_tube_jax.geometry import bar_covers, unit_vector
from trap_tube_jax.objects import BOARD_SIZE, EXIT, GROUND
from trap_tube_jax.state import State, take


def first_push(task: State, actions: jax.typing.ArrayLike) -> jax.Array:
    """Returns the first displacement of the food in an episode, i32[2]; zeros without a push.

    Unbatched; vmap it.

    Args:
      task: the state at time 0.
      actions: integer[T, 2], (grasp, move). Actions after a solution change nothing.
    """
    food = replay(task, actions).food
    displacement = food - food[:1]
    return displacement[jnp.argmax(jnp.any(displacement != 0, axis=-1))]


def choice_of_exit(task: State, push: jax.typing.ArrayLike) -> jax.Array:
    """Classifies a first push: towards the exit, away from it, or without a choice.

    A push is a choice if static objects let the food move one cell forward and one cell backward,
    and exactly one of these ways leads straight to an exit. Unbatched; vmap it.

    Args:
      task: the state at time 0.
      push: i32[2], as `first_push` returns it.

    Returns:
      i32[]: 1 for a choice towards the exit, -1 for a choice away from it, and 0 if the push is
      no choice or there is none.
    """
    push = jnp.asarray(push)
    can_move = _can_move(task, push) & _can_move(task, -push)
    forward = _leads_to_exit(task, push)
    backward = _leads_to_exit(task, -push)
    return jnp.where(can_move, forward.astype(jnp.int32) - backward.astype(jnp.int32), 0)


def first_grasp(task: State, actions: jax.typing.ArrayLike) -> jax.Array:
    """Classifies the first grasp of an episode: whether it held the tool.

    Grasps that point at neither tool, trap, exit nor tube do not count. Unbatched; vmap it.

    Args:
      task: the state at time 0.
      actions: integer[T, 2], (grasp, move). Actions after a solution change nothing.

    Returns:
      i32[]: 1 if the first grasp held the tool, -1 if it did not, and 0 without a grasp.
    """
    actions = jnp.asarray(actions)
    states = take(replay(task, actions), slice(len(actions)))
    grasps = jax.vmap(_grasp)(states, actions[:, 0])
    grasps = jnp.pad(grasps, (1, 0))  # entry 0, in case there is no grasp
    return grasps[jnp.argmax(grasps != 0)]


def _grasp(state: State, direction: jax.Array) -> jax.Array:
    """Classifies a grasp as `first_grasp` does."""
    cell = state.agent + unit_vector(direction)
    is_hidden = bar_covers(state.tool, state.tool_extent, cell)
    misses = (static_object(state.board, cell) > GROUND) & ~is_hidden
    held = holds_tool(state, direction).astype(jnp.int32)
    return jnp.where(state.done, 0, held - misses.astype(jnp.int32))


def _can_move(task: State, way: jax.Array) -> jax.Array:
    code = static_object(task.board, task.food + way)
    return (code == GROUND) | (code == EXIT)


def _leads_to_exit(task: State, way: jax.Array) -> jax.Array:
    """Tests whether the first object other than ground from the food on is an exit."""
    distance = jnp.arange(1, BOARD_SIZE, dtype=jnp.int32)
    cells = task.food[None] + distance[:, None] * way[None]
    codes = jax.vmap(static_object, in_axes=(None, 0))(task.board, cells)
    return codes[jnp.argmax(codes != GROUND)] == EXIT
