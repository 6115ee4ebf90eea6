"""Visit counts: the reward decreases with the number of visits in all of training.

Source: Tang et al. (2017).
"""

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from agents.curiosity.base import Curiosity, Experience, Params
from agents.networks.grouping import slots
from trap_tube_jax.environment import Environment

VISIT_BITS = 20  # hash bits; the table of visits has a slot for each value


class Counts(Curiosity):
    """reward: n^(-1/2), n the visits of the next observation so far, this iteration's included.

    Visits are counted in a table of 2^20 slots by a hash of the observation. Observations of one
    hash share a count. With n known observations, a new observation collides with probability n /
    2^20: 5 % at 50,000.

    Raises:
      ValueError: `env` has transfers other than `symbolic`. Such transfers draw so many tasks that
        observations hardly ever recur, and the table would fill up.
    """

    def __init__(self, env: Environment):
        if any(transfer is not tt.symbolic for transfer in env.transfers):
            names = [getattr(transfer, "__name__", str(transfer)) for transfer in env.transfers]
            raise ValueError(
                "curiosity 'counts' needs tasks that recur: base or Sy, no transfers or "
                f"symbolic alone, got {', '.join(names)}"
            )

    def memory(self) -> jax.Array:
        """Returns no visits, f32[2^20]."""
        return jnp.zeros(2**VISIT_BITS, jnp.float32)

    def reward(
        self, params: Params, memory: jax.Array, experience: Experience
    ) -> tuple[jax.Array, jax.Array]:
        """Returns the bonus of the next observation, and the visits so far."""
        boards = experience.episodes.observations()[1:]
        slot = slots(boards.reshape(*boards.shape[:2], -1), VISIT_BITS)
        return visit_bonus(memory, slot, experience.episodes.mask)


def visit_bonus(visits: jax.Array, slot: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Adds observations of slots i32[...] to the visits f32[S], where `mask` f32[...] is 1.

    Returns the bonus n^(-1/2) of each, f32[...], 0 where masked out, and the new visits.
    """
    visits = visits.at[slot.reshape(-1)].add(mask.reshape(-1))
    return mask / jnp.sqrt(jnp.maximum(visits[slot], 1.0)), visits
