"""The distribution of actions, predicted by the policy and by inverse models."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

import trap_tube_jax as tt


class ActionDistribution(NamedTuple):
    """Two independent categorical distributions, over grasp and move, with any leading axes.

    Attributes:
      logits: f32[..., 2, 4].
    """

    logits: jax.Array

    def sample(self, key: jax.Array) -> jax.Array:
        """Draws actions i32[..., 2], (grasp, move)."""
        draw = jax.vmap(jax.random.categorical, in_axes=(0, -2), out_axes=-1)
        return draw(jax.random.split(key), self.logits).astype(jnp.int32)

    def mode(self, penalty: jax.Array | None = None) -> jax.Array:
        """Returns the most probable actions i32[..., 2]; ties go to the lowest index.

        `penalty` f32[..., 4, 4] is subtracted from the log-probability of each (grasp, move).
        """
        if penalty is None:
            return jnp.argmax(self.logits, axis=-1).astype(jnp.int32)
        log_prob = jax.nn.log_softmax(self.logits)
        joint = log_prob[..., 0, :, None] + log_prob[..., 1, None, :] - penalty
        return tt.action_from_index(jnp.argmax(joint.reshape(*joint.shape[:-2], -1), axis=-1))

    def log_prob(self, action: jax.Array) -> jax.Array:
        """Returns log p(grasp) + log p(move), f32[...], of actions i32[..., 2]."""
        log_prob = jax.nn.log_softmax(self.logits)
        return jnp.sum(jnp.take_along_axis(log_prob, action[..., None], axis=-1), axis=(-2, -1))

    def entropy(self) -> jax.Array:
        """Returns the sum of both entropies, f32[...], in nats."""
        log_prob = jax.nn.log_softmax(self.logits)
        return -jnp.sum(jnp.exp(log_prob) * log_prob, axis=(-2, -1))
