"""A memory of the episodes that solved their task, to imitate them.

Source: self-imitation learning (Oh et al., 2018), here weighted by the return alone: a
success in a sparse task is better than what the policy expects anywhere on its way.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes, beside, take
from agents.acting.identity import observation_ids
from agents.parallel.sharding import Shards
from agents.ppo.returns import discounted_returns
from trap_tube_jax.state import State


class Imitated(NamedTuple):
    """Remembered successes as gradient steps see them: a device's share of K episodes.

    Attributes:
      episodes: the episodes.
      observation_id: i32[T + 1, K], equal only for equal observations.
      weight: f32[T, K], of every step's log-likelihood: its return, over the number of steps
        that are remembered; 0 after an episode's end.
    """

    episodes: Episodes
    observation_id: jax.Array
    weight: jax.Array

    @classmethod
    def of(cls, memory: Episodes, discount: float, shards: Shards) -> "Imitated":
        """This device's share, weighted so that the mean over devices is the whole."""
        steps = jnp.maximum(jnp.sum(memory.mask), 1.0) / shards.count
        if shards.count > 1:
            places, is_own = shards.places(memory.mask.shape[1])
            memory = take(memory, places)
            memory = memory._replace(mask=memory.mask * is_own[None])
        weight = discounted_returns(memory.reward, jnp.float32(discount)) * memory.mask
        return cls(memory, observation_ids(memory), weight / steps)


def empty(base: State, capacity: int, num_steps: int) -> Episodes:
    """A memory for `capacity` episodes of `num_steps` steps: their masks are 0 everywhere."""
    steps = (num_steps, capacity)
    return Episodes(
        layout=jax.tree.map(lambda x: jnp.broadcast_to(x, (capacity, *x.shape)), base),
        cells=jnp.zeros((num_steps + 1, capacity, 3, 2), jnp.uint8),
        action=jnp.zeros((*steps, 2), jnp.int32),
        reward=jnp.zeros(steps),
        discount=jnp.zeros(steps),
        mask=jnp.zeros(steps),
    )


def remember(memory: Episodes, played: Episodes) -> Episodes:
    """Puts the solved episodes of those played before the old ones; the oldest fall out."""
    played = played._replace(mask=played.mask * played.solved[None])
    both = beside(played, memory)
    is_useful = jnp.any(both.mask > 0, axis=0)
    kept = jnp.argsort(~is_useful, stable=True)[: memory.mask.shape[1]]
    return take(both, kept)
