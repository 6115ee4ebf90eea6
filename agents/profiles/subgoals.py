"""The last subgoal that an episode reached."""

from typing import NamedTuple

import jax
import numpy as np
from scipy import ndimage

import trap_tube_jax as tt
from trap_tube_jax import dynamics
from trap_tube_jax.geometry import bar_covers
from trap_tube_jax.objects import BOARD_SIZE, DIRECTIONS, GROUND

# In the order of a plan. Tool touched: the agent has grasped the tool. Tool moved and food moved:
# the object has left its initial cell. Food out: the agent can walk to the food without moving the
# tool.
SUBGOALS = ("none", "tool touched", "tool moved", "food moved", "food out")


class Cells(NamedTuple):
    """Cells of agent, tool and food in B episodes, i32[B, T + 1, 2] each."""

    agent: np.ndarray
    tool: np.ndarray
    food: np.ndarray


def replay(tasks: tt.State, actions: np.ndarray) -> Cells:
    """Replays B episodes.

    Args:
      tasks: B states at time 0.
      actions: i32[B, T, 2], (grasp, move). Actions after a solution change nothing.
    """
    return Cells(*jax.device_get(_replay(tasks, actions)))


@jax.jit
@jax.vmap
def _replay(task: tt.State, actions: jax.Array) -> tuple[jax.Array, ...]:
    states = dynamics.replay(task, actions)
    return states.agent, states.tool, states.food


def tool_moves(cells: Cells) -> np.ndarray:
    """Tests whether the tool leaves its initial cell, bool[B]."""
    return (cells.tool != cells.tool[:, :1]).any(axis=(1, 2))


def last_subgoals(tasks: tt.State, actions: np.ndarray, cells: Cells) -> np.ndarray:
    """Returns i32[B], the index in `SUBGOALS` of the last subgoal of B episodes.

    Takes the arguments of `replay`, and its result.
    """
    agent, tool, food = cells
    extent = np.asarray(tasks.tool_extent)[:, None]
    at_hand = bar_covers(tool[:, :-1], extent, agent[:, :-1] + DIRECTIONS[actions[..., 0]])
    is_inside = bar_covers(tool[:, :-1], extent, agent[:, :-1])
    reached = [
        np.ones(len(agent), bool),
        (at_hand & ~is_inside).any(axis=1),
        tool_moves(cells),
        (food != food[:, :1]).any(axis=(1, 2)),
        _walks_to_food(np.asarray(tasks.board), extent, agent, tool, food).any(axis=1),
    ]
    return np.max(np.arange(len(SUBGOALS))[:, None] * reached, axis=0)


def _walks_to_food(board: np.ndarray, extent: np.ndarray, *cells: np.ndarray) -> np.ndarray:
    """Tests whether the agent can walk to the food without moving the tool, bool[B, T].

    `board` is u8[B, 12, 12], the tool's `extent` i32[B, 1, 2], and the `cells` of agent, tool and
    food i32[B, T, 2].
    """
    cell = np.moveaxis(np.indices((BOARD_SIZE, BOARD_SIZE)), 0, -1)
    agent, tool, food = (x[:, :, None, None] for x in cells)
    is_tool = bar_covers(tool, extent[:, :, None, None], cell)
    is_food = (cell == food).all(axis=-1) & ~is_tool
    is_free = ((board == GROUND)[:, None] & ~is_tool) | is_food
    start = (cell == agent).all(axis=-1)
    steps = ndimage.generate_binary_structure(2, 1)[None, None]
    return (ndimage.binary_propagation(start, steps, mask=is_free) & is_food).any(axis=(2, 3))
