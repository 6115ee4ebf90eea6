"""Tasks that the agent failed, to be played again.

Where most tasks of a set are easy, what the others need is lost among them. So failed tasks are
played again, as the same draws of `env.reset`. A replayed task that fails again is copied to the
next of L lists. Each list is thus poorer in easy tasks than the one before, though nobody says
which tasks are hard. A task stays in its list, solved or not, until newer ones overwrite it: what
has just been learnt is worth repeating.

Source: own; a simple relative of prioritized level replay, Jiang et al. (2021).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp


class TaskReplay(NamedTuple):
    """L lists of K tasks each; list l holds tasks that were failed l + 1 times.

    At first the lists hold tasks that nobody has tried.

    Attributes:
      keys: PRNG keys [L, K] that `env.reset` draws the tasks from.
      next: i32[L], the place of each list that is filled next.
    """

    keys: jax.Array
    next: jax.Array

    @staticmethod
    def untried(key: jax.Array, lists: int, capacity: int) -> "TaskReplay":
        """Lists of tasks that nobody has tried yet; one list, unused, in place of none."""
        lists = max(lists, 1)  # checkpoints hold no empty arrays
        keys = jax.random.split(key, (lists, capacity))
        return TaskReplay(keys, jnp.zeros(lists, jnp.int32))

    def draw(self, key: jax.Array, counts: Sequence[int]) -> jax.Array:
        """Reset keys of tasks to play again: `counts[l]` from list l, each with equal chances."""
        drawn = [
            keys[jax.random.randint(list_key, (count,), 0, len(keys))]
            for keys, list_key, count in zip(
                self.keys, jax.random.split(key, len(counts)), counts, strict=True
            )
        ]
        return jnp.concatenate(drawn)

    def remember(
        self, reset_keys: jax.Array, failed: jax.Array, counts: Sequence[int]
    ) -> "TaskReplay":
        """The lists after an iteration: each task that failed is added to the next list.

        Args:
          reset_keys: PRNG keys [M] of an iteration's tasks: new ones, then those of `draw`.
          failed: bool[M].
          counts: as in `draw`. Tasks of the last list are not added again.
        """
        ends = list(itertools.accumulate([len(failed) - sum(counts), *counts]))
        played = jnp.split(reset_keys, ends)[: len(counts)]
        fails = jnp.split(failed, ends)[: len(counts)]
        lists = [
            _put(*of_list) for of_list in zip(self.keys, self.next, played, fails, strict=True)
        ]
        keys, following = zip(*lists, strict=True)
        return TaskReplay(jnp.stack(keys), jnp.stack(following))


def _put(
    keys: jax.Array, start: jax.Array, new: jax.Array, chosen: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """A list [K] with the chosen of `new` [M] from place `start` on, and the place after them.

    Of more than K the last K are put.
    """
    order, total = jnp.cumsum(chosen, dtype=jnp.int32), jnp.sum(chosen, dtype=jnp.int32)
    fits = chosen & (order > total - len(keys))
    place = jnp.where(fits, (start + order - 1) % len(keys), len(keys))
    return keys.at[place].set(new, mode="drop"), (start + total) % len(keys)
