"""ICM, the paper's curiosity: the error in predicting the next output of the policy's GRU.

Source: paper, section "Results"; Pathak et al. (2017); agents/agent.md, "Network", "Curiosity".
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.config import Config
from agents.curiosity.base import Curiosity, Experience, Params
from agents.networks.actions import ActionDistribution
from agents.networks.layers import dense, draw, output_dense
from trap_tube_jax.objects import NUM_DIRECTIONS


class ForwardModel(nn.Module):
    """Predicts the next embedding from the present one and the action: h + dense([h, action])."""

    @nn.compact
    def __call__(self, embedding: jax.Array, action: jax.Array) -> jax.Array:
        """Maps f32[..., H] and f32[..., E] to f32[..., H]."""
        x = jnp.concatenate([embedding, action], axis=-1)
        return embedding + output_dense(embedding.shape[-1])(x)


class InverseModel(nn.Module):
    """Predicts the action between two embeddings, by one layer of `hidden` units and two heads."""

    hidden: int

    @nn.compact
    def __call__(self, embedding: jax.Array, next_embedding: jax.Array) -> ActionDistribution:
        """Maps two embeddings f32[..., H] to the distribution of the action."""
        x = nn.swish(dense(self.hidden)(jnp.concatenate([embedding, next_embedding], axis=-1)))
        grasp = output_dense(NUM_DIRECTIONS, name="grasp")(x)
        return ActionDistribution(grasp, output_dense(NUM_DIRECTIONS, name="move")(x))


class ICM(Curiosity):
    """Forward and inverse models over the policy's own GRU outputs.

    No gradient is stopped, so both losses train the policy's encoder.
    """

    needs_next_embedding = True

    def __init__(self, config: Config):
        self._forward, self._inverse = ForwardModel(), InverseModel(config.hidden)
        self._widths = (config.hidden, 2 * config.embedding)

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """Draws the parameters of both models."""
        embedding, action = (jnp.zeros((1, width), jnp.float32) for width in self._widths)
        params = {
            "forward": self._forward.init(key, embedding, action),
            "inverse": self._inverse.init(key, embedding, embedding),
        }
        return draw(key, params)

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """Returns the sum over units of the forward model's squared errors."""
        error, _ = self.predict(params, experience)
        return jnp.sum(error, axis=-1), memory

    def losses(self, params: Params, experience: Experience) -> dict[str, jax.Array]:
        """Returns the mean over units of the same errors, and -log p(action)."""
        error, action = self.predict(params, experience)
        return {
            "forward_loss": jnp.mean(error, axis=-1),
            "inverse_loss": -action.log_prob(experience.episodes.action),
        }

    def predict(self, params: Params, experience: Experience) -> Any:
        """Returns the squared errors f32[T, B, H] of predicted h', and the inferred action."""
        here, there = experience.embedding, experience.next_embedding
        predicted: Any = self._forward.apply(params["forward"], here, experience.action_embedding)
        inferred = self._inverse.apply(params["inverse"], here, there)
        return jnp.square(predicted - there), inferred
