"""Tasks that the agent failed, to be played again.

Where most tasks of a set are easy, what the others need is lost among them. A task that was failed
is played again, as the same draw of `env.reset`, until it is solved or newer failures take its
place.

Source: own; a simple relative of prioritized level replay, Jiang et al. (2021).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

SMALL = 1e-4  # weight of solved tasks, which are drawn where nothing else is left


class Failures(NamedTuple):
    """K places for failed tasks, filled in turn.

    Attributes:
      keys: u32[K, ...], data of the PRNG keys that `env.reset` draws the tasks from.
      unsolved: f32[K], 1 until the task is solved.
      next: i32[], the place of the next failure.
    """

    keys: jax.Array
    unsolved: jax.Array
    next: jax.Array

    @staticmethod
    def untried(key: jax.Array, capacity: int) -> "Failures":
        """K tasks that nobody has tried yet."""
        keys = jax.random.key_data(jax.random.split(key, capacity))
        return Failures(keys, jnp.ones(capacity), jnp.zeros((), jnp.int32))

    def draw(self, key: jax.Array, count: int) -> jax.Array:
        """The places i32[count] of tasks to play, unsolved ones with equal probability."""
        weight = self.unsolved + SMALL
        return jax.random.choice(key, len(weight), (count,), p=weight / jnp.sum(weight))

    def reset_keys(self, places: jax.Array) -> jax.Array:
        """The PRNG keys of the tasks at these places, i32[M]."""
        return jax.random.wrap_key_data(self.keys[places])

    def without(self, places: jax.Array, solved: jax.Array) -> "Failures":
        """The tasks at i32[M] count as solved where bool[M] says so."""
        return self._replace(unsolved=self.unsolved.at[places].multiply(1.0 - solved))

    def with_new(self, reset_keys: jax.Array, failed: jax.Array) -> "Failures":
        """With tasks of PRNG keys [M] where they were failed, bool[M], in the oldest places."""
        capacity = len(self.unsolved)
        order = jnp.cumsum(failed.astype(jnp.int32))
        place = jnp.where(failed, (self.next + order - 1) % capacity, capacity)
        return Failures(
            keys=self.keys.at[place].set(jax.random.key_data(reset_keys), mode="drop"),
            unsolved=self.unsolved.at[place].set(1.0, mode="drop"),
            next=(self.next + order[-1]) % capacity,
        )
