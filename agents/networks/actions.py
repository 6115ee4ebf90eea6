"""The distribution of actions, predicted by the policy and by inverse models."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class ActionDistribution(NamedTuple):
    """Two independent categorical distributions, of grasp and move; leading axes are free.

    Attributes:
      grasp_logits: f32[..., 4].
      move_logits: f32[..., 4].
    """

    grasp_logits: jax.Array
    move_logits: jax.Array

    def sample(self, key: jax.Array) -> jax.Array:
        """Draws actions i32[..., 2], (grasp, move)."""
        keys = jax.random.split(key)
        drawn = [jax.random.categorical(*pair) for pair in zip(keys, self, strict=True)]
        return jnp.stack(drawn, axis=-1).astype(jnp.int32)

    def mode(self, penalty: jax.Array | None = None) -> jax.Array:
        """Returns the most probable actions i32[..., 2]; ties go to the lowest index.

        `penalty` f32[..., 4, 4] is subtracted from the log-probability of each (grasp, move).
        """
        if penalty is None:
            chosen = [jnp.argmax(logits, axis=-1) for logits in self]
            return jnp.stack(chosen, axis=-1).astype(jnp.int32)
        grasp, move = (jax.nn.log_softmax(logits) for logits in self)
        joint = grasp[..., :, None] + move[..., None, :] - penalty
        index = jnp.argmax(joint.reshape(*joint.shape[:-2], -1), axis=-1).astype(jnp.int32)
        return jnp.stack([index // move.shape[-1], index % move.shape[-1]], axis=-1)

    def log_prob(self, action: jax.Array) -> jax.Array:
        """Returns log p(grasp) + log p(move), f32[...], of actions i32[..., 2]."""
        choices = jnp.split(action, 2, axis=-1)
        grasp, move = (
            jnp.take_along_axis(jax.nn.log_softmax(logits), choice, axis=-1)[..., 0]
            for logits, choice in zip(self, choices, strict=True)
        )
        return grasp + move

    def entropy(self) -> jax.Array:
        """Returns the sum of both entropies, f32[...], in nats."""
        grasp, move = (jax.nn.log_softmax(logits) for logits in self)
        return -jnp.sum(jnp.exp(grasp) * grasp, axis=-1) - jnp.sum(jnp.exp(move) * move, axis=-1)
