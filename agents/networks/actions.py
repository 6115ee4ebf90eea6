"""The distribution of an action: grasp and move, drawn independently of each other.

All that concerns probabilities of actions is here: the policy and the curiosity's inverse model
both yield an `ActionDistribution`.
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp


class ActionDistribution(NamedTuple):
    """Two independent categorical distributions; leading axes are free.

    Attributes:
      grasp_logits: f32[..., 4].
      move_logits: f32[..., 4].
    """

    grasp_logits: jax.Array
    move_logits: jax.Array

    def sample(self, key: jax.Array) -> jax.Array:
        """Draws an action i32[..., 2], (grasp, move)."""
        grasp_key, move_key = jax.random.split(key)
        grasp = jax.random.categorical(grasp_key, self.grasp_logits)
        move = jax.random.categorical(move_key, self.move_logits)
        return jnp.stack([grasp, move], axis=-1).astype(jnp.int32)

    def mode(self) -> jax.Array:
        """The most probable action i32[..., 2]; of equals the first."""
        choices = [jnp.argmax(logits, axis=-1) for logits in self]
        return jnp.stack(choices, axis=-1).astype(jnp.int32)

    def log_prob(self, action: jax.Array) -> jax.Array:
        """Log p(grasp) + log p(move), f32[...], of an action i32[..., 2]."""
        grasp = _log_prob(self.grasp_logits, action[..., 0])
        return grasp + _log_prob(self.move_logits, action[..., 1])

    def entropy(self) -> jax.Array:
        """The sum of both entropies, f32[...], in nats."""
        return _entropy(self.grasp_logits) + _entropy(self.move_logits)


def _log_prob(logits: jax.Array, choice: jax.Array) -> jax.Array:
    chex.assert_equal_shape_prefix([logits, choice[..., None]], choice.ndim)
    log_probs = jax.nn.log_softmax(logits)
    return jnp.take_along_axis(log_probs, choice[..., None], axis=-1)[..., 0]


def _entropy(logits: jax.Array) -> jax.Array:
    log_probs = jax.nn.log_softmax(logits)
    return -jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)
