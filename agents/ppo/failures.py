"""Tasks that the agent failed, to be played again.

Where most tasks of a set are easy, what the others need is lost among them. A task that was failed
is played again, as the same draw of `env.reset`, until newer failures take its place. It stays
when it has been solved meanwhile: what has just been learnt is what bears repetition.

Source: own; a simple relative of prioritized level replay, Jiang et al. (2021).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Failures(NamedTuple):
    """K places for failed tasks, filled in turn.

    Attributes:
      keys: u32[K, ...], data of the PRNG keys that `env.reset` draws the tasks from.
      next: i32[], the place of the next failure.
    """

    keys: jax.Array
    next: jax.Array

    @staticmethod
    def untried(key: jax.Array, capacity: int) -> "Failures":
        """K tasks that nobody has tried yet."""
        keys = jax.random.key_data(jax.random.split(key, capacity))
        return Failures(keys, jnp.zeros((), jnp.int32))

    def draw(self, key: jax.Array, count: int) -> jax.Array:
        """The reset keys [count] of tasks to play again, all with equal probability."""
        places = jax.random.randint(key, (count,), 0, len(self.keys))
        return jax.random.wrap_key_data(self.keys[places])

    def remember(self, reset_keys: jax.Array, failed: jax.Array) -> "Failures":
        """With tasks of PRNG keys [M] where they were failed, bool[M], in the oldest places."""
        capacity = len(self.keys)
        order = jnp.cumsum(failed.astype(jnp.int32))
        place = jnp.where(failed, (self.next + order - 1) % capacity, capacity)
        keys = self.keys.at[place].set(jax.random.key_data(reset_keys), mode="drop")
        return Failures(keys, (self.next + order[-1]) % capacity)
