"""The distribution of actions, which the policy and the curiosity's inverse model both predict."""

from typing import NamedTuple

import chex
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

    def mode(self) -> jax.Array:
        """Returns the most probable actions i32[..., 2]; ties go to the lowest index."""
        chosen = [jnp.argmax(logits, axis=-1) for logits in self]
        return jnp.stack(chosen, axis=-1).astype(jnp.int32)

    def log_prob(self, action: jax.Array) -> jax.Array:
        """Returns log p(grasp) + log p(move), f32[...], of actions i32[..., 2]."""
        grasp, move = action[..., 0], action[..., 1]
        return _log_prob(self.grasp_logits, grasp) + _log_prob(self.move_logits, move)

    def entropy(self) -> jax.Array:
        """Returns the sum of both entropies, f32[...], in nats."""
        return _entropy(self.grasp_logits) + _entropy(self.move_logits)


def _log_prob(logits: jax.Array, choice: jax.Array) -> jax.Array:
    chex.assert_equal_shape_prefix([logits, choice[..., None]], choice.ndim)
    return jnp.take_along_axis(jax.nn.log_softmax(logits), choice[..., None], axis=-1)[..., 0]


def _entropy(logits: jax.Array) -> jax.Array:
    log_probs = jax.nn.log_softmax(logits)
    return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)
