"""Where episodes start: at fresh tasks, or inside successes that were come by before.

A reward too far to be found by trying is near when the episode begins a few steps before a
known success. The first successes come from random walks: without observations and without a
network those take millions of steps a second, so that even the rare ones are had by the
thousand. Every success is then rehearsed from its end. Whenever the agent solves a restart, the
next one begins a little earlier, otherwise a little later; a success that is solved from its
first known step is dropped, and makes room for another.

The agent sees none of this: a restart is an ordinary state of a task.

Source: restarts along a known success after Salimans and Chen (2018) and Ecoffet et al. (2021).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.config import Config
from agents.rollout import cells_of, place
from trap_tube_jax.environment import Environment
from trap_tube_jax.objects import NUM_DIRECTIONS
from trap_tube_jax.registry import make
from trap_tube_jax.state import State

# A random walk repeats its grasp and its direction with these probabilities: a tool is moved
# by holding on to it.
GRASP_PERSISTENCE, MOVE_PERSISTENCE = 0.97, 0.6
REMEMBERED = 3  # episodes' worth of steps of a success that are kept
FIRST_REACH = 4
DETOUR, GRACE = 2, 8  # a restart k steps before a success has DETOUR * k + GRACE steps
FRESH = -1


class Ways(NamedTuple):
    """B episodes of S steps, of which some came to success.

    Attributes:
      layout: B states, of which board, palette and tool extent hold all the way.
      cells: u8[S + 1, B, 3, 2], the (row, column) of agent, tool and food, by time.
      length: i32[B], steps to the success; 0 if there was none.
    """

    layout: State
    cells: jax.Array
    length: jax.Array


class Successes(NamedTuple):
    """K places for ways to success, seen from their ends; empty places have length 0.

    Attributes:
      layout: K states, of which board, palette and tool extent hold all the way.
      cells: u8[S + 1, K, 3, 2], the (row, column) of agent, tool and food, by the number of
        steps left to the success.
      length: i32[K], steps known, at most S.
      reach: i32[K], steps before the success at which the next restart begins.
    """

    layout: State
    cells: jax.Array
    length: jax.Array
    reach: jax.Array

    @staticmethod
    def empty(config: Config, base: State) -> "Successes":
        """Before training; as small as it may be if there are no restarts."""
        capacity = config.restart_memory if config.restarts else 1
        num_steps = REMEMBERED * config.max_steps if config.restarts else 1
        return Successes(
            layout=jax.tree.map(lambda x: jnp.broadcast_to(x, (capacity, *x.shape)), base),
            cells=jnp.zeros((num_steps + 1, capacity, 3, 2), jnp.uint8),
            length=jnp.zeros(capacity, jnp.int32),
            reach=jnp.zeros(capacity, jnp.int32),
        )

    @property
    def number(self) -> jax.Array:
        """i32[]: how many there are."""
        return jnp.sum(self.length > 0, dtype=jnp.int32)

    @property
    def mean_reach(self) -> jax.Array:
        """f32[]: over those that there are; 0 if there are none."""
        return jnp.sum(self.reach * (self.length > 0)) / jnp.maximum(self.number, 1)

    def add(self, ways: Ways) -> "Successes":
        """Puts the ways that came to success into empty places, as far as there are any.

        They begin to be rehearsed half as far back as the others are on average.
        """
        count = min(len(ways.length), len(self.length))
        way = jnp.argsort(ways.length == 0, stable=True)[:count]
        spot = jnp.argsort(self.length > 0, stable=True)[:count]
        fits = (ways.length[way] > 0) & (self.length[spot] == 0)
        left = jnp.arange(len(self.cells))
        time = jnp.clip(ways.length[way][None] - left[:, None], 0, len(ways.cells) - 1)
        length = jnp.minimum(ways.length[way], len(self.cells) - 1)
        reach = jnp.maximum((self.mean_reach / 2).astype(jnp.int32), FIRST_REACH)
        new = Successes(
            layout=jax.tree.map(lambda x: x[way], ways.layout),
            cells=jnp.take_along_axis(ways.cells[:, way], time[..., None, None], axis=0),
            length=length,
            reach=jnp.minimum(reach, length),
        )

        def put(old: jax.Array, new: jax.Array) -> jax.Array:
            return old.at[spot].set(_where(fits, new, old[spot]), unique_indices=True)

        return Successes(
            layout=jax.tree.map(put, self.layout, new.layout),
            cells=put(self.cells.swapaxes(0, 1), new.cells.swapaxes(0, 1)).swapaxes(0, 1),
            length=put(self.length, new.length),
            reach=put(self.reach, new.reach),
        )

    def rehearsed(self, origin: jax.Array, solved: jax.Array) -> "Successes":
        """Moves the next restarts according to the outcomes of B episodes.

        Args:
          origin: i32[B], the success that each restarted, or `FRESH`.
          solved: bool[B].
        """
        reach = self.reach[origin]
        step = jnp.where(solved, 2 + reach // 8, -(1 + reach // 4))
        elsewhere = len(self.reach)  # out of bounds, hence dropped
        reach = self.reach.at[jnp.where(origin == FRESH, elsewhere, origin)].add(step, mode="drop")
        return self._replace(
            length=jnp.where(reach > self.length, 0, self.length), reach=jnp.maximum(reach, 1)
        )

    def choose(self, key: jax.Array, config: Config) -> jax.Array:
        """Decides where the episodes of an iteration start.

        Returns:
          i32[episodes], the success to restart, or `FRESH`; fresh ones come first.
        """
        number = self.number
        drawn = jax.random.randint(key, (config.episodes,), 0, jnp.maximum(number, 1))
        occupied = jnp.argsort(self.length == 0, stable=True)
        num_fresh = config.episodes - round(config.episodes * config.restarts)
        is_fresh = (jnp.arange(config.episodes) < num_fresh) | (number == 0)
        return jnp.where(is_fresh, FRESH, occupied[drawn])

    def place(self, origin: jax.Array, tasks: State, max_steps: int) -> State:
        """The initial states [B] of episodes.

        The nearer to the success, the fewer steps are left to a restart, so that little is
        spent on what goes wrong.

        Args:
          origin: i32[B], from `choose`.
          tasks: B fresh tasks.
          max_steps: of an episode.
        """
        reach = self.reach[origin]
        layout = jax.tree.map(lambda x: x[origin], self.layout)
        restarts = jax.vmap(place)(layout, self.cells[reach, origin])
        time = jnp.maximum(max_steps - (DETOUR * reach + GRACE), 0)
        restarts = restarts.replace(time=time)
        return jax.tree.map(
            lambda restart, task: _where(origin == FRESH, task, restart), restarts, tasks
        )


def explore(
    key: jax.Array, envs: list[tuple[Environment, int]], successes: Successes
) -> tuple[Successes, jax.Array]:
    """Looks for more successes by random walks, if a tenth of the places is empty.

    Args:
      key: PRNG key.
      envs: environments, each with the number of walks.
      successes: those that there are.

    Returns:
      The successes with what was found, and f32[], the steps walked.
    """

    def search(successes: Successes) -> Successes:
        for index, (env, number) in enumerate(envs):
            walks = random_walks(env, jax.random.fold_in(key, index), number)
            successes = successes.add(walks)
        return successes

    has_room = successes.number <= 0.9 * len(successes.length)
    found = jax.lax.cond(has_room, search, lambda successes: successes, successes)
    steps = sum(number * env.max_steps for env, number in envs)
    return found, jnp.where(has_room, float(steps), 0.0)


def walk_environments(config: Config) -> list[tuple[Environment, int]]:
    """Those of `config.walk_sets`, each with the number of its walks.

    Raises:
      ValueError: an unknown task set.
    """
    return [
        (make(name, num_features=config.num_features, max_steps=config.walk_steps), number)
        for name, number in zip(config.walk_sets, config.walks, strict=True)
    ]


def random_walks(env: Environment, key: jax.Array, number: int) -> Ways:
    """Walks from fresh tasks that keep their grasp and their direction for a while."""
    reset_key, walk_key = jax.random.split(key)
    initial, _ = jax.vmap(env.reset)(jax.random.split(reset_key, number))
    persistence = jnp.array([[GRASP_PERSISTENCE, MOVE_PERSISTENCE]])

    def step(
        carry: tuple[State, jax.Array], step_key: jax.Array
    ) -> tuple[tuple[State, jax.Array], jax.Array]:
        state, action = carry
        new_key, keep_key = jax.random.split(step_key)
        new = jax.random.randint(new_key, action.shape, 0, NUM_DIRECTIONS)
        action = jnp.where(jax.random.uniform(keep_key, action.shape) < persistence, action, new)
        after, _ = jax.vmap(env.step)(state, action)
        return (after, action), cells_of(state)

    start = (initial, jnp.zeros((number, 2), jnp.int32))
    (end, _), cells = jax.lax.scan(step, start, jax.random.split(walk_key, env.max_steps))
    return Ways(
        layout=initial,
        cells=jnp.concatenate([cells, cells_of(end)[None]]),
        length=jnp.where(end.terminated, end.time, 0),
    )


def _where(condition: jax.Array, x: jax.Array, y: jax.Array) -> jax.Array:
    """Chooses rows [B, ...] by bool[B]."""
    return jnp.where(condition.reshape((-1,) + (1,) * (x.ndim - 1)), x, y)
