"""A memory of the episodes that solved their task, to imitate them.

Source: self-imitation learning (Oh et al., 2018), here weighted by the return alone: a
success in a sparse task is better than what the policy expects anywhere on its way.
"""

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes, along_episodes, take
from trap_tube_jax.state import State


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
    both = along_episodes(lambda axis, *x: jnp.concatenate(x, axis), played, memory)
    is_useful = jnp.any(both.mask > 0, axis=0)
    kept = jnp.argsort(~is_useful, stable=True)[: memory.mask.shape[1]]
    return take(both, kept)
