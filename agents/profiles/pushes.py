"""The first push of an episode, and whether it goes the right way.

Source: controls.md, "The paired test".
"""

from typing import NamedTuple

import numpy as np

from agents.profiles.oracle import LOST, Oracle
from trap_tube_jax.objects import DIRECTIONS
from trap_tube_jax.state import State

NO_PUSH = -1


class Push(NamedTuple):
    """The first push of an episode.

    Attributes:
      direction: where the food went, as in actions; `NO_PUSH` if it never moved.
      right: whether the distance to the goal fell with it.
    """

    direction: int
    right: bool


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
