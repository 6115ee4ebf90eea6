"""Replay of failed tasks.

If most tasks of a set are easy, few updates teach the hard tasks. So failed tasks are replayed: the
same reset keys draw the same tasks. A replayed task that fails again is copied to the next of L
lists. Each list therefore holds fewer easy tasks than the list before, without any measure of
difficulty. A task stays in its list, solved or not, until newer tasks overwrite it, so the agent
rehearses new skills.

Source: this project; a simple relative of prioritized level replay, Jiang et al. (2021).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp


class TaskReplay(NamedTuple):
    """L lists of K tasks each; list l holds tasks failed l + 1 times, at first untried tasks.

    Attributes:
      keys: PRNG keys [L, K] from which `env.reset` draws the tasks.
      next: i32[L], for each list, the index that is overwritten next.
    """

    keys: jax.Array
    next: jax.Array

    @staticmethod
    def untried(key: jax.Array, lists: int, capacity: int) -> "TaskReplay":
        """Returns lists of untried tasks."""
        keys = jax.random.split(key, (lists, capacity))
        return TaskReplay(keys, jnp.zeros(lists, jnp.int32))

    def draw(self, key: jax.Array, counts: Sequence[int]) -> jax.Array:
        """Draws the reset keys of `counts[l]` tasks from each list l, with equal probabilities."""
        # Keys are used again on purpose; `jax_debug_key_reuse` allows it for clones only.
        drawn = [
            keys[jax.random.randint(list_key, (count,), 0, len(keys), jnp.int32)]
            for keys, list_key, count in zip(
                jax.random.clone(self.keys), jax.random.split(key, len(counts)), counts, strict=True
            )
        ]
        return jnp.concatenate(drawn)

    def remember(
        self, reset_keys: jax.Array, failed: jax.Array, counts: Sequence[int]
    ) -> "TaskReplay":
        """Adds each failed task of an iteration to the next list.

        Args:
          reset_keys: PRNG keys [M] of the tasks: new ones, then the ones from `draw`.
          failed: bool[M].
          counts: as in `draw`. Tasks of the last list are not added again.
        """
        if not counts:
            return self
        reset_keys = jax.random.clone(reset_keys)
        new = len(failed) - sum(counts)
        parts = itertools.pairwise([0, *itertools.accumulate([new, *counts[:-1]])])
        lists = [
            _put(self.keys[index], self.next[index], reset_keys[start:end], failed[start:end])
            for index, (start, end) in enumerate(parts)
        ]
        keys, following = zip(*lists, strict=True)
        # Not by `stack`, whose result `jax_debug_key_reuse` takes for used.
        return TaskReplay(jnp.concatenate(keys).reshape(self.keys.shape), jnp.stack(following))


def _put(
    keys: jax.Array, start: jax.Array, new: jax.Array, chosen: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Puts the chosen of `new` [M] into a list [K] from index `start` on.

    Returns:
      The list, with the last K chosen if there are more, and the index after them.
    """
    order = jnp.cumsum(chosen, dtype=jnp.int32)
    total = jnp.sum(chosen, dtype=jnp.int32)
    fits = chosen & (order > total - len(keys))
    index = jnp.where(fits, (start + order - 1) % len(keys), len(keys))
    return keys.at[index].set(new, mode="drop"), (start + total) % len(keys)
