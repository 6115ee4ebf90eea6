"""The paper's curiosity: how badly the next output of the policy's GRU is predicted.

Source: paper, section "Results"; Pathak et al. (2017); agents/agent.md, "Curiosity".
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.config import Config
from agents.curiosity.base import Curiosity, Experience, Params
from agents.curiosity.models import ForwardModel, InverseModel
from agents.networks.actions import ActionDistribution
from agents.networks.layers import init_module


class Models(nn.Module):
    """Forward and inverse model over the policy's embeddings.

    Attributes:
      hidden: units of the inverse model.
    """

    hidden: int

    def setup(self) -> None:
        """Declares the two models."""
        self.forward = ForwardModel()
        self.inverse = InverseModel(self.hidden)

    def __call__(
        self, embedding: jax.Array, next_embedding: jax.Array, action_embedding: jax.Array
    ) -> tuple[jax.Array, ActionDistribution]:
        """The squared errors f32[..., H] of the predicted next embedding; the inferred action."""
        predicted = self.forward(embedding, action_embedding)
        error = jnp.square(predicted - next_embedding)
        return error, self.inverse(embedding, next_embedding)


class ICM(Curiosity):
    """Forward and inverse models over the policy's own GRU outputs.

    reward: the forward model's squared error, summed over units. losses: its mean over units,
    and the negative log-likelihood of the action under the inverse model. No gradient is
    stopped, so both losses shape the policy's encoder.
    """

    needs_embeddings = True

    def __init__(self, config: Config):
        self._models = Models(config.hidden)
        self._widths = (config.hidden, config.hidden, 2 * config.embedding)

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """The parameters of both models; `board` is not looked at."""
        inputs = (jnp.zeros((1, width)) for width in self._widths)
        return init_module(self._models, key, *inputs)

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """The sum over units of the forward model's squared errors."""
        error, _ = self.predict(params, experience)
        return jnp.sum(error, axis=-1), memory

    def losses(self, params: Params, experience: Experience) -> dict[str, jax.Array]:
        """The mean over units of the same errors, and -log p(action)."""
        error, action = self.predict(params, experience)
        return {
            "forward_loss": jnp.mean(error, axis=-1),
            "inverse_loss": -action.log_prob(experience.episodes.action),
        }

    def predict(self, params: Params, experience: Experience) -> Any:
        """The squared errors f32[T, B, H] of h' as predicted, and the inferred action."""
        x = experience
        return self._models.apply(params, x.embedding, x.next_embedding, x.action_embedding)
