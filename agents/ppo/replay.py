"""A memory of the episodes that solved their task, to imitate them.

Source: self-imitation learning (Oh et al., 2018), here weighted by the return alone: a
success in a sparse task is better than what the policy expects anywhere on its way.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.rollout import Trajectory
from trap_tube_jax.state import State


class Replay(NamedTuple):
    """The newest K solved episodes of T steps; empty places have an empty mask.

    Attributes:
      layout: K states, of which board, palette and tool extent hold for the episode.
      cells: u8[T + 1, K, 3, 2], the (row, column) of agent, tool and food.
      action: i32[T, K, 2].
      reward: f32[T, K], extrinsic.
      mask: f32[T, K].
    """

    layout: State
    cells: jax.Array
    action: jax.Array
    reward: jax.Array
    mask: jax.Array

    @staticmethod
    def empty(base: State, capacity: int, num_steps: int) -> "Replay":
        """A memory of `capacity` episodes of `num_steps` steps without any success."""
        steps = (num_steps, capacity)
        return Replay(
            layout=jax.tree.map(lambda x: jnp.broadcast_to(x, (capacity, *x.shape)), base),
            cells=jnp.zeros((num_steps + 1, capacity, 3, 2), jnp.uint8),
            action=jnp.zeros((*steps, 2), jnp.int32),
            reward=jnp.zeros(steps),
            mask=jnp.zeros(steps),
        )

    def remember(self, trajectory: Trajectory) -> "Replay":
        """Puts the solved episodes of B before the old ones; the oldest fall out."""
        played = Replay(
            trajectory.layout,
            trajectory.cells,
            trajectory.action,
            trajectory.reward,
            trajectory.mask * trajectory.solved[None],
        )
        both = Replay(
            jax.tree.map(lambda *x: jnp.concatenate(x), played.layout, self.layout),
            *(jnp.concatenate(x, axis=1) for x in zip(played[1:], self[1:], strict=True)),
        )
        useful = jnp.any(both.mask > 0, axis=0)
        kept = jnp.argsort(~useful, stable=True)[: self.mask.shape[1]]
        return both.take(kept)

    def take(self, episodes: jax.Array) -> "Replay":
        """The episodes at these places, i32[M]."""
        rest = [x[:, episodes] for x in self[1:]]
        return Replay(jax.tree.map(lambda x: x[episodes], self.layout), *rest)
