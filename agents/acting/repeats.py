"""Repeats: how often an episode has taken each action at the current observation.

The environment is deterministic, so repeating an action at the same observation has the same
effect. A policy that always takes the most probable action may therefore walk in circles. With
`Config.repeat_penalty`, greedy play takes the action of the highest

  log p(a | o, h) - repeat_penalty * n(o, a),

where n counts how many of the episode's last 64 steps took this action at this observation.

Source: this project.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from agents.networks.actions import ActionDistribution
from agents.networks.hashing import hash_rows
from trap_tube_jax.objects import NUM_ACTIONS, NUM_DIRECTIONS

MEMORY = 64  # steps


class Repeats(NamedTuple):
    """The last observations of B episodes and the actions taken there, newest first.

    Attributes:
      board: i32[B, MEMORY], hashes of the observations.
      action: i32[B, MEMORY], 4 * grasp + move; -1 before the first step.
    """

    board: jax.Array
    action: jax.Array

    @staticmethod
    def empty(batch: int) -> "Repeats":
        """Returns the memory of `batch` episodes before their first step."""
        # Two arrays, since a buffer can be donated only once.
        return Repeats(*(jnp.full((batch, MEMORY), -1, jnp.int32) for _ in range(2)))

    def choose(
        self, actions: ActionDistribution, penalty: float, observation: jax.Array
    ) -> tuple[jax.Array, "Repeats"]:
        """Returns the best actions i32[B, 2] at boards u8[B, 12, 12, N], and the next memory."""
        # Different observations hardly ever have the same hash.
        board = hash_rows(observation.reshape(len(observation), -1)).astype(jnp.int32)
        is_same = (self.board == board[:, None]).astype(jnp.float32)
        taken = jax.nn.one_hot(self.action, NUM_ACTIONS, dtype=jnp.float32)
        counts = jnp.einsum("bt,bta->ba", is_same, taken)
        counts = counts.reshape(-1, NUM_DIRECTIONS, NUM_DIRECTIONS)
        action = actions.mode(penalty * counts)
        newest = Repeats(board, tt.action_to_index(action))
        return action, jax.tree.map(_push, self, newest)


def _push(rows: jax.Array, newest: jax.Array) -> jax.Array:
    """Puts `newest` [B] before rows [B, K], whose last entries drop out."""
    return jnp.concatenate([newest[:, None], rows[:, :-1]], axis=1)
