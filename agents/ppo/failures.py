"""Tasks that the agent failed, to be played again.

Where most tasks of a set are easy, what the others need is lost among them. So tasks that were
failed are played again, as the same draw of `env.reset`. Those that are failed once more rise to
the next of L lists. Each list is thus poorer in easy tasks than the one below, though nobody says
which tasks are hard. A task stays in its list, solved or not, until newer ones take its place:
what has just been learnt is what bears repetition.

Source: own; a simple relative of prioritized level replay, Jiang et al. (2021).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp


class Failures(NamedTuple):
    """L lists of K tasks each; list l holds tasks that were failed l + 1 times.

    Attributes:
      keys: u32[L, K, ...], data of the PRNG keys that `env.reset` draws the tasks from.
      next: i32[L], the place of each list that is filled next.
    """

    keys: jax.Array
    next: jax.Array

    @staticmethod
    def untried(key: jax.Array, lists: int, capacity: int) -> "Failures":
        """Lists of tasks that nobody has tried yet; one list, unused, in place of none."""
        lists = max(lists, 1)  # checkpoints hold no empty arrays
        keys = jax.random.key_data(jax.random.split(key, (lists, capacity)))
        return Failures(keys, jnp.zeros(lists, jnp.int32))

    def draw(self, key: jax.Array, counts: Sequence[int]) -> jax.Array:
        """Reset keys of tasks to play again: `counts[l]` from list l, each with equal chances."""
        drawn = [
            keys[jax.random.randint(list_key, (count,), 0, len(keys))]
            for keys, list_key, count in zip(
                self.keys, jax.random.split(key, len(counts)), counts, strict=True
            )
        ]
        return jax.random.wrap_key_data(jnp.concatenate(drawn))

    def remember(
        self, reset_keys: jax.Array, failed: jax.Array, counts: Sequence[int]
    ) -> "Failures":
        """With the tasks that were failed, each one list further up.

        Args:
          reset_keys: PRNG keys [M] of an iteration's tasks: new ones, then those of `draw`.
          failed: bool[M].
          counts: as in `draw`. Tasks of the last list stay where they are.
        """
        ends = list(itertools.accumulate([len(failed) - sum(counts), *counts]))
        played = jnp.split(jax.random.key_data(reset_keys), ends)[: len(counts)]
        fails = jnp.split(failed, ends)[: len(counts)]
        lists = [
            _put(*of_list) for of_list in zip(self.keys, self.next, played, fails, strict=True)
        ]
        keys, following = zip(*lists, strict=True)
        return Failures(jnp.stack(keys), jnp.stack(following))


def _put(
    keys: jax.Array, start: jax.Array, new: jax.Array, chosen: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """A list [K, ...] with the chosen of `new` [M, ...] from place `start` on, and what follows."""
    order = jnp.cumsum(chosen.astype(jnp.int32))
    place = jnp.where(chosen, (start + order - 1) % len(keys), len(keys))
    return keys.at[place].set(new, mode="drop"), (start + jnp.sum(chosen)) % len(keys)
