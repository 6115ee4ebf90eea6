"""Distances to the goal, for every state that a task can reach.

Source: environment.md, "One step".
"""

import numpy as np

from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.positions import NUM_POSITIONS
from trap_tube_jax.solver.search import levels, validate_on_host
from trap_tube_jax.state import State

UNKNOWN = -1


def distances(state: State) -> np.ndarray:
    """Computes the distance to the goal of every state that is reachable. Runs on the host.

    d(s) = 0 if s is solved, else 1 + min over the 16 actions a of d(step(s, a)).

    Exploring the whole graph, up to two million states, takes seconds. `solve` stops at the goal.

    Args:
      state: one unbatched state, at any time of an unfinished episode.

    Returns:
      i16[12, 12, 12, 12, 12, 12], fewest steps until the reward; -1 for states that are unreachable
      or have no way to the goal. Indexed by the row and column of the food, then of the tool's
      top-left cell, then of the agent. Valid for this board and this size of tool only.

    Raises:
      ValueError: see `solve`.

    Example:
      >>> state = tt.State.from_ascii(["A...F1....TT", "111111......", *["." * 12] * 10])
      >>> to_goal = tt.distances(state)[(*state.food, *state.tool)]
      >>> to_goal[0, :6].tolist()  # with the agent in the first cells of row 0
      [4, 3, 2, 1, 0, -1]
    """
    found = list(levels(validate_on_host(state)))
    nodes, successors, solved = (
        np.concatenate([getattr(level, name) for level in found])
        for name in ("nodes", "successors", "solved")
    )
    to_goal = _distances_to_goal(nodes, successors, solved)
    by_agent_first = to_goal.reshape((BOARD_SIZE,) * 6)
    return by_agent_first.transpose(4, 5, 2, 3, 0, 1)


def _distances_to_goal(nodes: np.ndarray, successors: np.ndarray, solved: np.ndarray) -> np.ndarray:
    """Computes i16[144^3], breadth-first, backward from the solved nodes.

    Args:
      nodes: i32[n], the unsolved nodes.
      successors: i32[n, 16], the nodes after the 16 actions.
      solved: bool[n, 16], the action solves the task.
    """
    to_goal = np.full(NUM_POSITIONS, UNKNOWN, np.int16)
    to_goal[successors[solved]] = 0
    for distance in range(1, NUM_POSITIONS):
        is_next = (to_goal[successors] == distance - 1).any(axis=1)
        if not is_next.any():
            break
        to_goal[nodes[is_next]] = distance
        nodes = nodes[~is_next]
        successors = successors[~is_next]
    return to_goal
