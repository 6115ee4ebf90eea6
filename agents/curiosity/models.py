"""The two models of an intrinsic curiosity module, and features that they shape.

Source: Pathak et al. (2017); agents/agent.md, "Network".
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.networks.actions import ActionDistribution
from agents.networks.layers import dense, output_dense
from trap_tube_jax.objects import NUM_DIRECTIONS


class InverseModel(nn.Module):
    """Which action led from one embedding to the next: one hidden layer, two heads."""

    hidden: int

    @nn.compact
    def __call__(self, embedding: jax.Array, next_embedding: jax.Array) -> ActionDistribution:
        """The distribution of the action, from two f32[..., H]."""
        x = nn.swish(dense(self.hidden)(jnp.concatenate([embedding, next_embedding], axis=-1)))
        grasp = output_dense(NUM_DIRECTIONS, name="grasp")(x)
        return ActionDistribution(grasp, output_dense(NUM_DIRECTIONS, name="move")(x))


class ForwardModel(nn.Module):
    """The next embedding from this one and the action: h + dense([h, action])."""

    @nn.compact
    def __call__(self, embedding: jax.Array, action: jax.Array) -> jax.Array:
        """f32[..., H] and f32[..., E] to f32[..., H]."""
        x = jnp.concatenate([embedding, action], axis=-1)
        return embedding + output_dense(embedding.shape[-1])(x)


class InverseFeatures(nn.Module):
    """An encoder of its own and an inverse model over its features.

    Attributes:
      hidden: units of the inverse model.
      encoder: from observations u8[M, 12, 12, N] to features f32[M, F].
    """

    hidden: int
    encoder: nn.Module

    def setup(self) -> None:
        """Declares the inverse model."""
        self.inverse = InverseModel(self.hidden)

    def __call__(self, observation: jax.Array, next_observation: jax.Array) -> ActionDistribution:
        """The inferred action between two observations u8[M, 12, 12, N]."""
        return self.inverse(self.encoder(observation), self.encoder(next_observation))
