"""The oracle along episodes: the distance to the goal in every state that was visited.

A state's distance is the length of the shortest plan from it. One search per state would do; here
each plan that is found also gives the distances of all the states on it.
"""

import jax
import jax.numpy as jnp
import numpy as np

from agents.acting.episodes import cells_of
from trap_tube_jax import dynamics
from trap_tube_jax.positions import position_id
from trap_tube_jax.solver.search import replay, solve
from trap_tube_jax.state import State

LOST = -1  # of a distance: no plan leads to the goal any more; the length of such a `Plan` too


class Oracle:
    """Distances to the goal, kept from one question to the next."""

    def __init__(self) -> None:
        """Knows nothing yet."""
        self._known: dict[tuple[bytes, int], int] = {}

    def distance(self, layout: State, cells: np.ndarray) -> int:
        """The fewest steps to the goal, 0 where it is reached; `LOST` where there is no way.

        Args:
          layout: a state of NumPy arrays, of which board and tool extent count.
          cells: u8[3, 2], where agent, tool and food are.
        """
        if np.array_equal(cells[0], cells[2]):
            return 0
        where = np.asarray(layout.board).tobytes() + np.asarray(layout.tool_extent).tobytes()
        agent, tool, food = np.asarray(cells, np.int32)
        state = layout.replace(agent=agent, tool=tool, food=food)
        here = int(position_id(state))
        if (where, here) not in self._known:
            plan = solve(state)
            self._known[where, here] = int(plan.length)
            for step, at in enumerate(replay(state, plan)[:-1]):
                self._known[where, int(position_id(at))] = len(plan.actions) - step
        return self._known[where, here]

    def along(self, layout: State, cells: np.ndarray) -> np.ndarray:
        """i32[T]: the distance in each of an episode's states, which u8[T, 3, 2] tells.

        What is lost stays lost. So the first such state is found by halving: to know that
        there is no way takes a search of all that can be reached.
        """
        distances = np.full(len(cells), LOST, np.int32)
        end = len(cells)
        if self.distance(layout, cells[-1]) == LOST:
            low, end = 0, len(cells) - 1
            while low < end:
                middle = (low + end) // 2
                if self.distance(layout, cells[middle]) == LOST:
                    end = middle
                else:
                    low = middle + 1
        distances[:end] = [self.distance(layout, each) for each in cells[:end]]
        return distances


@jax.jit
def replayed(tasks: State, actions: jax.Array) -> jax.Array:
    """u8[B, T + 1, 3, 2]: the cells of agent, tool and food along B episodes.

    Args:
      tasks: B states at time 0.
      actions: i32[B, T, 2]; after the task is solved they change nothing.
    """

    def step(states: State, action: jax.Array) -> tuple[State, jax.Array]:
        states = jax.vmap(dynamics.step)(states, action)
        return states, cells_of(states)

    _, cells = jax.lax.scan(step, tasks, actions.swapaxes(0, 1))
    return jnp.concatenate([cells_of(tasks)[None], cells]).swapaxes(0, 1)
