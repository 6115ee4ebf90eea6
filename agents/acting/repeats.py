"""Repeats: how often an episode has taken each action at the present observation.

The environment is deterministic: an action that is repeated at the same observation has the same
effect again, and a policy that always takes the most probable action may walk in circles. With
`Config.repeat_penalty`, greedy play takes the action of the highest

  log p(a | o, h) - repeat_penalty * n(o, a),

n counting those of the last 64 steps of the episode that took this action at this observation.

Source: own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.networks.grouping import hash_rows
from trap_tube_jax.objects import NUM_ACTIONS, NUM_DIRECTIONS

MEMORY = 64  # steps


class Repeats(NamedTuple):
    """The last observations of B episodes and the actions taken there, newest first.

    Attributes:
      observation: i32[MEMORY, B], see `board_ids`.
      action: i32[MEMORY, B], 4 * grasp + move; -1 before the first step.
    """

    observation: jax.Array
    action: jax.Array

    @staticmethod
    def empty(batch: int) -> "Repeats":
        """Returns the memory of `batch` episodes before their first step."""
        nothing = jnp.full((MEMORY, batch), -1, jnp.int32)
        return Repeats(nothing, nothing)

    def counts(self, observation: jax.Array) -> jax.Array:
        """Returns how often each action was taken at the observations i32[B], f32[B, 4, 4]."""
        is_same = (self.observation == observation[None]).astype(jnp.float32)
        taken = jax.nn.one_hot(self.action, NUM_ACTIONS, dtype=jnp.float32)
        counts = jnp.einsum("tb,tba->ba", is_same, taken)
        return counts.reshape(-1, NUM_DIRECTIONS, NUM_DIRECTIONS)

    def add(self, observation: jax.Array, action: jax.Array) -> "Repeats":
        """Adds a step with observations i32[B] and actions i32[B, 2]."""
        newest = Repeats(observation, action[:, 0] * NUM_DIRECTIONS + action[:, 1])
        return jax.tree.map(lambda x, old: jnp.concatenate([x[None], old[:-1]]), newest, self)


def board_ids(observation: jax.Array) -> jax.Array:
    """Hashes observations u8[B, 12, 12, N] to i32[B]; different ones hardly ever agree."""
    return hash_rows(observation.reshape(len(observation), -1)).astype(jnp.int32)
