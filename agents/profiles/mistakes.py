"""Where plans go wrong: when an episode leaves the shortest way, and how far it comes.

The distance to the goal falls by one in every step of a shortest plan. Elsewhere a step leaves it
as it is, raises it, or makes it infinite: the food, or the agent, is where no plan helps any more.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from agents.profiles.oracle import LOST, Oracle
from trap_tube_jax.objects import BOARD_SIZE, DIRECTIONS, GROUND
from trap_tube_jax.state import State

NEVER = -1
NO_PUSH = -1
INFINITE = 1_000_000  # more than any distance
SUBGOALS = ("tool touched", "tool moved", "food moved", "food out")


class Turns(NamedTuple):
    """At which steps, counted from 1, the distance to the goal changes; `NEVER` if at none.

    Attributes:
      last_fell: the last step that brought the goal nearer.
      first_rose: the first step that took it farther away, or made it infinite.
      lost: the step that made it infinite.
      nearest: the step after which it was as small as it ever got, for the first time.
    """

    last_fell: int
    first_rose: int
    lost: int
    nearest: int


class Push(NamedTuple):
    """The first push of an episode.

    Attributes:
      direction: where the food went, as in actions; `NO_PUSH` if it never moved.
      right: whether the distance to the goal fell with it.
    """

    direction: int
    right: bool


def turns(distance: np.ndarray) -> Turns:
    """Those of an episode.

    Args:
      distance: i32[T + 1], the distance to the goal at each time, `LOST` where infinite.
    """
    lost = distance == LOST
    finite = np.where(lost, INFINITE, distance)
    change, low = np.diff(finite), finite.min()
    nearest = _first(finite[1:] == low) if low < finite[0] else NEVER
    return Turns(_last(change < 0), _first(change > 0), _first(lost[1:]), nearest)


def first_push(oracle: Oracle, layout: State, cells: np.ndarray) -> Push:
    """The first push of an episode, from u8[T + 1, 3, 2], the cells of agent, tool and food."""
    food = cells[:, 2].astype(np.int32)
    moves = np.diff(food, axis=0)
    pushes = np.flatnonzero(moves.any(axis=1))
    if not len(pushes):
        return Push(NO_PUSH, False)
    step = int(pushes[0])
    after = oracle.distance(layout, cells[step + 1])
    right = after != LOST and after < oracle.distance(layout, cells[step])
    return Push(int(np.argmax((DIRECTIONS == moves[step]).all(axis=1))), right)


def subgoals(layout: State, cells: np.ndarray, actions: np.ndarray) -> tuple[int, ...]:
    """The step at which each of `SUBGOALS` was reached, 0 at the start; `NEVER` if it was not.

    Tool touched: the agent grasped it (environment.md, "One step"). Tool moved, food moved: it is
    elsewhere than at the start. Food out: the agent can walk to it, with the tool left where it is.

    Args:
      layout: a state of the episode.
      cells: u8[T + 1, 3, 2], the cells of agent, tool and food at each time.
      actions: i32[T, 2].
    """
    agent, tool, food = np.moveaxis(cells.astype(np.int32), 1, 0)
    moved = [_first((each[1:] != each[0]).any(axis=1)) for each in (tool, food)]
    extent = np.asarray(layout.tool_extent)
    at_hand = agent[:-1] + DIRECTIONS[actions[:, 0]]
    grasped = _covers(tool[:-1], extent, at_hand) & ~_covers(tool[:-1], extent, agent[:-1])
    out = walks_to_food(np.asarray(layout.board), extent, cells)
    return (_first(grasped), *moved, int(np.argmax(out)) if out.any() else NEVER)


def walks_to_food(board: np.ndarray, extent: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """bool[T]: whether the agent can walk to the food without moving the tool.

    Args:
      board: u8[12, 12].
      extent: i32[2], the tool's.
      cells: u8[T, 3, 2], the cells of agent, tool and food.
    """
    agent, tool, food = np.moveaxis(cells.astype(np.int32), 1, 0)
    every = np.moveaxis(np.indices((BOARD_SIZE, BOARD_SIZE)), 0, -1)[None]
    is_tool = _covers(tool[:, None, None], extent, every)
    is_food = (every == food[:, None, None]).all(axis=-1) & ~is_tool
    is_free = ((board == GROUND) & ~is_tool) | is_food
    start = (every == agent[:, None, None]).all(axis=-1)
    beside = ndimage.generate_binary_structure(2, 1)[None]
    reached = ndimage.binary_propagation(start, beside, mask=is_free)
    return np.any(reached & is_food, axis=(1, 2))


def _covers(corner: np.ndarray, extent: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """bool[...]: whether the tool at `corner` covers `cell`."""
    return np.all((cell >= corner) & (cell < corner + extent), axis=-1)


def _first(happens: np.ndarray) -> int:
    """The first step, counted from 1, of bool[T]."""
    return int(np.argmax(happens)) + 1 if happens.any() else NEVER


def _last(happens: np.ndarray) -> int:
    return len(happens) - int(np.argmax(happens[::-1])) if happens.any() else NEVER
