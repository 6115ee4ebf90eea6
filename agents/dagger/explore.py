"""What random walks find out about a task: from where, and in how many steps, it is solved.

A single walk hardly ever solves a task and never knows how well it did. Thousands of short
ones share what they saw. They start where few have been before, and the transitions of all
of them together make up a graph of states. Its shortest ways to the goal, by dynamic
programming, are far shorter than any walk that contributed to them.

The walks need neither observations nor a network: they cost some hundred nanoseconds a step. They
use nothing but `step` and the places of agent, tool and food, all of which an observation
shows, and a task that is set back to a state where a walk has been.

Source: returning to rarely seen states after Ecoffet et al. (2021); dynamic programming over
recorded transitions after Sutton (1990).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.rollout import place
from agents.config import Config
from agents.networks import distinct
from trap_tube_jax.environment import Environment, action_from_index
from trap_tube_jax.objects import NUM_ACTIONS, NUM_DIRECTIONS
from trap_tube_jax.state import State

# A walk repeats its grasp and its direction with these probabilities: a tool is moved by
# holding on to it.
GRASP_PERSISTENCE, MOVE_PERSISTENCE = 0.97, 0.6
CONTENDERS = 64  # states seen, of which the rarest starts the next walk
SWEEPS = 3
UNKNOWN = 255


class Atlas(NamedTuple):
    """What is known of one task.

    Attributes:
      task: its first state.
      steps: u8[144^3], by `distinct.position_id`: steps to the goal on the shortest way that
        walks have pieced together; `UNKNOWN` where there is none.
    """

    task: State
    steps: jax.Array

    @staticmethod
    def of(task: State, *walks: jax.Array) -> "Atlas":
        """What walks in a task, each array i32[T + 1, W] positions by time, have seen of it."""
        return Atlas(task, shortest_ways(*walks))

    def sample(self, key: jax.Array, number: int) -> State:
        """States from which a way to the goal is known, [number], uniformly.

        The first state of the task where there are none.
        """
        is_known = (self.steps > 0) & (self.steps != UNKNOWN)
        # By the agent's cell first, which spares counting through all of the table.
        by_cell = is_known.reshape(distinct.NUM_CELLS, -1)
        inside = jnp.sum(by_cell, axis=1, dtype=jnp.int32)
        up_to = jnp.cumsum(inside)
        wanted = jax.random.randint(key, (number,), 0, jnp.maximum(up_to[-1], 1)) + 1
        cell = jnp.searchsorted(up_to, wanted)
        rank = jnp.cumsum(by_cell[cell], axis=1, dtype=jnp.int32)
        left = (wanted - (up_to - inside)[cell])[:, None]
        found = cell * by_cell.shape[1] + jnp.argmax(rank >= left, axis=1)
        position = jnp.where(up_to[-1] > 0, found, distinct.position_id(self.task))
        return jax.vmap(self._at)(position)

    def _at(self, position: jax.Array) -> State:
        return place(self.task, distinct.cells_at(position))


def explore(env: Environment, task: State, key: jax.Array, config: Config) -> jax.Array:
    """Walks about in a task, round after round from where tool and food have rarely been.

    The agent gets anywhere by itself. What it takes walks to find out is what can be moved where.

    Args:
      env: the dynamics.
      task: a state at time 0.
      key: PRNG key.
      config: the number of walkers, their rounds and the steps of a round.

    Returns:
      The positions i32[walk_steps + 1, W] of all walks.
    """
    walkers, rounds = config.walkers, config.walk_rounds
    shape = (rounds, config.walk_steps + 1, walkers)

    def visit(
        carry: tuple[jax.Array, ...], inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, ...], None]:
        seen, visits, start = carry
        number, key = inputs
        walk_key, choice_key = jax.random.split(key)
        walked = walk(env, task, start, walk_key, config.walk_steps)
        seen = seen.at[number].set(walked)
        visits = visits.at[_moved(walked.reshape(-1))].add(1)
        # Only rounds up to this one have been walked.
        drawn = jax.random.randint(choice_key, (CONTENDERS, walkers), 0, (number + 1) * walked.size)
        contender = seen.reshape(-1)[drawn]
        score = jnp.where(is_goal(contender), jnp.iinfo(jnp.int32).max, visits[_moved(contender)])
        chosen = jnp.argmin(score, axis=0)
        start = jnp.take_along_axis(contender, chosen[None], axis=0)[0]
        return (seen, visits, start), None

    nothing = (
        jnp.zeros(shape, jnp.int32),
        jnp.zeros(distinct.NUM_CELLS**2, jnp.int32),
        jnp.broadcast_to(distinct.position_id(task), walkers),
    )
    (seen, _, _), _ = jax.lax.scan(
        visit, nothing, (jnp.arange(rounds), jax.random.split(key, rounds))
    )
    return seen.swapaxes(0, 1).reshape(shape[1], -1)


def walk(
    env: Environment, task: State, start: jax.Array, key: jax.Array, num_steps: int
) -> jax.Array:
    """Walks that keep their grasp and their direction for a while.

    Args:
      env: the dynamics.
      task: a state of the task at time 0.
      start: i32[W], positions.
      key: PRNG key.
      num_steps: T, at most those of an episode.

    Returns:
      The positions i32[T + 1, W].
    """
    states = jax.vmap(lambda position: place(task, distinct.cells_at(position)))(start)
    first_key, walk_key = jax.random.split(key)
    persistence = jnp.array([[GRASP_PERSISTENCE, MOVE_PERSISTENCE]])

    def step(
        carry: tuple[State, jax.Array], step_key: jax.Array
    ) -> tuple[tuple[State, jax.Array], jax.Array]:
        state, action = carry
        new_key, keep_key = jax.random.split(step_key)
        new = _draw_actions(new_key, len(action))
        action = jnp.where(jax.random.uniform(keep_key, action.shape) < persistence, action, new)
        after, _ = jax.vmap(env.step)(state, action)
        return (after, action), jax.vmap(distinct.position_id)(after)

    first = (states, _draw_actions(first_key, len(start)))
    _, positions = jax.lax.scan(step, first, jax.random.split(walk_key, num_steps))
    return jnp.concatenate([start[None], positions])


def look_ahead(
    env: Environment, state: State, known: Callable[[State], jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """The actions after which the goal is nearest, and those of which anything is known.

    Args:
      env: the dynamics.
      state: any state of the task.
      known: u8[] for a state of the task: the steps to the goal, or `UNKNOWN`.

    Returns:
      bool[16] each; all false where no action leads to a state with a known way to the goal.
    """
    actions = action_from_index(jnp.arange(NUM_ACTIONS))
    after, _ = jax.vmap(env.step, in_axes=(None, 0))(state, actions)
    steps = jnp.where(after.terminated, 0, jax.vmap(known)(after))
    is_known = steps != UNKNOWN
    return is_known & (steps == jnp.min(steps)), is_known


def _draw_actions(key: jax.Array, number: int) -> jax.Array:
    return jax.random.randint(key, (number, 2), 0, NUM_DIRECTIONS)


def _moved(position: jax.Array) -> jax.Array:
    """i32[...]: where tool and food are, by `distinct.position_id`."""
    return position % distinct.NUM_CELLS**2


def is_goal(position: jax.Array) -> jax.Array:
    """bool[...]: whether agent and food share a cell, by `distinct.position_id`."""
    return position // distinct.NUM_CELLS**2 == position % distinct.NUM_CELLS


def shortest_ways(*walks: jax.Array) -> jax.Array:
    """u8[144^3]: steps to the goal over walks, i32[T + 1, W] each: V(s) = min(V(s), 1 + V(s')).

    Each sweep goes back in time, so that what is known at the end of a walk reaches its
    beginning at once; further sweeps carry it over to walks that were met.
    """
    steps = jnp.full(distinct.NUM_POSITIONS, UNKNOWN, jnp.uint8)
    for last in (walk[-1] for walk in walks):
        goals = jnp.where(is_goal(last), last, distinct.NUM_POSITIONS)
        steps = steps.at[goals].set(0, mode="drop")

    def back(steps: jax.Array, transition: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        before, after = transition
        beyond = steps[after]
        return steps.at[before].min(beyond + (beyond < UNKNOWN - 1).astype(jnp.uint8)), None

    for _ in range(SWEEPS):
        for walk in walks:
            steps, _ = jax.lax.scan(back, steps, (walk[:-1], walk[1:]), reverse=True)
    return steps
