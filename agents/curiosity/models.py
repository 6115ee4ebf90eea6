"""The two models of an intrinsic curiosity module.

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
