"""Visit counts: an observation pays by how seldom training has seen it.

Source: Tang et al. (2017).
"""

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from agents.acting.episodes import Episodes
from agents.acting.identity import layout_hashes, position_ids
from agents.curiosity.base import Curiosity, Experience, Params
from agents.networks.grouping import slots
from trap_tube_jax.environment import Environment

VISIT_BITS = 20  # of an observation's hash, in the table of visits


class Counts(Curiosity):
    """reward: n^(-1/2), n the visits of the next observation so far, this iteration's included.

    Visits are counted in a table of 2^20 slots, by a hash of the observation; observations with
    the same hash share a count. While n observations are known, a new one shares with
    probability n / 2^20: 5 % at 50,000.

    Counts tell something only where tasks recur: base (1 layout) and {Sy} (5 layouts).
    `perceptual` and `structural` draw so many tasks that hardly any observation is met again, and
    the table would fill with what never returns. So they are refused.

    Args:
      env: the environment.

    Raises:
      ValueError: the environment draws tasks by anything but `symbolic`.
    """

    def __init__(self, env: Environment):
        if any(transfer is not tt.symbolic for transfer in env.transfers):
            names = [getattr(transfer, "__name__", str(transfer)) for transfer in env.transfers]
            raise ValueError(
                "curiosity 'counts' needs tasks that return: base or Sy, no transfers or "
                f"symbolic alone, got {', '.join(names)}"
            )

    def memory(self) -> jax.Array:
        """No visits yet, f32[2^20]."""
        return jnp.zeros(2**VISIT_BITS)

    def reward(
        self, params: Params, memory: jax.Array, experience: Experience
    ) -> tuple[jax.Array, jax.Array]:
        """The bonus of the next observation, and the visits with this iteration's."""
        episodes = experience.episodes
        return visit_bonus(memory, observation_slots(episodes)[1:], episodes.mask)


def observation_slots(episodes: Episodes) -> jax.Array:
    """i32[T + 1, B]: the slot of every observation."""
    position = position_ids(episodes)
    layout = jnp.broadcast_to(layout_hashes(episodes.layout), position.shape)
    rows = jnp.stack([layout, position.astype(jnp.uint32)], axis=-1)
    return slots(rows, VISIT_BITS)


def visit_bonus(visits: jax.Array, slot: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Pays observations by the inverse root of how often they have been seen.

      n(o) <- n(o) + visits of o in this batch,  bonus = n(o)^(-1/2).

    Args:
      visits: f32[S], visits so far.
      slot: i32[...], the slot of every observation.
      mask: f32[...], 1 where an observation counts.

    Returns:
      The bonus f32[...], 0 where masked out, and the new visits f32[S].
    """
    visits = visits.at[slot.reshape(-1)].add(mask.reshape(-1))
    return mask / jnp.sqrt(jnp.maximum(visits[slot], 1.0)), visits
