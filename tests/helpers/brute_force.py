"""An exhaustive search over the rules as `spec_reference` reads them.

Shares no code with the package, on purpose. A position is (agent, tool, food), flat cells; the
tool's is its top-left one.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

import helpers.spec_reference as spec

GRASP, MOVE = np.divmod(np.arange(16), 4)
SHIFTS = spec.DIRECTIONS[MOVE] @ (12, 1)


class Level(NamedTuple):
    """Positions i64[n, 3] at one distance, successors i64[n, 16, 3], and solved bool[n, 16]."""

    positions: np.ndarray
    successors: np.ndarray
    solved: np.ndarray


class Graph(NamedTuple):
    """All positions i64[n, 3] that can be reached, the start first, and fewest steps to the goal.

    The successors i32[n, 16] are indices of positions, -1 for a solved position, which has none. A
    distance f64[n] is infinite where there is no way.
    """

    positions: np.ndarray
    successors: np.ndarray
    to_goal: np.ndarray


def levels(state) -> Iterator[Level]:
    """Yields the unsolved positions once, those with the fewest steps from the state first."""
    layout = spec.Layouts(np.asarray(state.board), np.asarray(state.tool_extent))
    cells = (state.agent, state.tool, state.food)
    positions = (np.stack(cells) @ (12, 1))[None]
    known = set()
    while len(positions):
        known |= set(map(tuple, positions.tolist()))
        agent, tool, food = (spec.Cell(*np.divmod(axis, 12)) for axis in positions.T[..., None])
        moved = spec.step(layout, agent, tool, food, (GRASP[None], MOVE[None]))
        moves = np.stack([moved.agent, moved.tool, moved.food], axis=-1)
        following = positions[:, None] + moves * SHIFTS[:, None]
        yield Level(positions, following, moved.solved)
        new = np.unique(following[~moved.solved], axis=0)
        positions = new[[tuple(position) not in known for position in new.tolist()]]


def graph(state) -> Graph:
    """Explores everything that can be reached from a state."""
    found, following, solved = map(np.concatenate, zip(*levels(state), strict=True))
    goals = np.unique(following[solved], axis=0)
    positions = np.concatenate([found, goals])
    index = {position: number for number, position in enumerate(map(tuple, positions.tolist()))}
    successors = np.full((len(positions), 16), -1, np.int32)  # SciPy 1.14 takes no wider indices
    successors[: len(found)] = [[index[tuple(to)] for to in row] for row in following.tolist()]
    starts = np.repeat(np.arange(len(found), dtype=np.int32), 16)
    edges = starts, successors[: len(found)].ravel()
    matrix = csr_array((np.ones(len(edges[0])), edges), (len(positions), len(positions)))
    to_goal = np.full(len(positions), np.inf)
    if len(goals):
        ends = np.arange(len(found), len(positions))
        to_goal = dijkstra(matrix.T, unweighted=True, indices=ends, min_only=True)
    return Graph(positions, successors, to_goal)


def first_plan(state) -> list[list[int]] | None:
    """The shortest plan whose actions (grasp, move) come first, step by step, or None."""
    _, successors, to_goal = graph(state)
    if np.isinf(to_goal[0]):
        return None
    position = 0
    plan = []
    while to_goal[position]:
        action = int(np.argmin(to_goal[successors[position]]))
        plan.append([*divmod(action, 4)])
        position = successors[position, action]
    return plan
