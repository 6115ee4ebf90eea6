"""Distances from the start and to the goal, for every state that a task can reach.

Source: environment.md, "One step".
"""

import numpy as np
from flax import struct

from trap_tube_jax.by_value import ByValue
from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.positions import NUM_POSITIONS
from trap_tube_jax.solver.search import levels, validate_on_host
from trap_tube_jax.state import State

UNKNOWN = -1


class Distances(ByValue, struct.PyTreeNode, eq=False):
    """Shortest distances in one task, in steps. NumPy arrays.

    Both arrays are indexed by the row and column of the food, then of the tool's top-left cell,
    then of the agent: `to_goal[(*state.food, *state.tool)]` is i16[12, 12] over the agent's cells.
    The distances are valid for this board and this size of tool only.

    Attributes:
      from_start: i16[12, 12, 12, 12, 12, 12], steps from the task's first state; -1 for
        unreachable states.
      to_goal: i16[12, 12, 12, 12, 12, 12], fewest steps until the reward; 0 for solved states,
        -1 for states that are unreachable or have no way to the goal.

    Example:
      >>> state = tt.State.from_ascii(["A...F1....TT", "111111......", *["." * 12] * 10])
      >>> to_goal = tt.distances(state).to_goal[(*state.food, *state.tool)]
      >>> to_goal[0, :6].tolist()  # with the agent in the first cells of row 0
      [4, 3, 2, 1, 0, -1]
    """

    from_start: np.ndarray
    to_goal: np.ndarray

    @property
    def num_reachable(self) -> int:
        """Number of distinct reachable states, solved ones included."""
        return int(np.count_nonzero(self.from_start != UNKNOWN))

    def lookup(self, states: State) -> np.ndarray:
        """Returns `to_goal` i16[...] of states of this task, with any leading axes."""
        cells = (np.asarray(cell) for cell in (states.food, states.tool, states.agent))
        return self.to_goal[tuple(axis for cell in cells for axis in np.moveaxis(cell, -1, 0))]


def distances(state: State) -> Distances:
    """Computes the distances of every state that is reachable from `state`. Runs on the host.

    d(s) = 0 if s is solved, else 1 + min over the 16 actions a of d(step(s, a)).

    Exploring the whole graph, up to two million states, takes seconds. `solve` stops at the goal.

    Args:
      state: one unbatched state, at any time of an unfinished episode.

    Raises:
      ValueError: see `solve`.

    Example:
      >>> state = tt.State.from_ascii(["A...F1....TT", "111111......", *["." * 12] * 10])
      >>> found = tt.distances(state)
      >>> found.num_reachable, int(found.lookup(state))
      (5, 4)
    """
    from_start, nodes, successors = _explore(validate_on_host(state))
    to_goal = _distances_to_goal(from_start, nodes, successors)
    return Distances(_by_cells(from_start), _by_cells(to_goal))


def _by_cells(table: np.ndarray) -> np.ndarray:
    """Reorders a table by position to the cells of food, tool and agent."""
    by_agent_first = table.reshape((BOARD_SIZE,) * 6)
    return by_agent_first.transpose(4, 5, 2, 3, 0, 1)


def _explore(state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns `from_start` i16[144^3], the unsolved nodes i32[n], their successors i32[n, 16]."""
    from_start = np.full(NUM_POSITIONS, UNKNOWN, np.int16)
    nodes = []
    successors = []
    for depth, level in enumerate(levels(state)):
        from_start[level.nodes] = depth
        solved = level.successors[level.solved]
        from_start[solved[from_start[solved] == UNKNOWN]] = depth + 1
        nodes.append(level.nodes)
        successors.append(level.successors)
    return from_start, np.concatenate(nodes), np.concatenate(successors)


def _distances_to_goal(
    from_start: np.ndarray, nodes: np.ndarray, successors: np.ndarray
) -> np.ndarray:
    """Computes `to_goal` i16[144^3], breadth-first, backward from the solved nodes."""
    to_goal = np.where(from_start == UNKNOWN, np.int16(UNKNOWN), np.int16(0))
    to_goal[nodes] = UNKNOWN
    for distance in range(1, NUM_POSITIONS):
        is_next = (to_goal[successors] == distance - 1).any(axis=1)
        if not is_next.any():
            break
        to_goal[nodes[is_next]] = distance
        nodes = nodes[~is_next]
        successors = successors[~is_next]
    return to_goal
