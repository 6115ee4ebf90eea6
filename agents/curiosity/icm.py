"""The paper's curiosity: how badly the next output of the policy's GRU is predicted.

Source: paper, section "Results"; Pathak et al. (2017); agents/agent.md, "Curiosity".
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents.config import Config
from agents.curiosity.base import Curiosity, Experience, Params
from agents.curiosity.models import ForwardModel, InverseModel
from agents.networks.layers import draw


class ICM(Curiosity):
    """Forward and inverse models over the policy's own GRU outputs.

    reward: the forward model's squared error, summed over units. losses: its mean over units,
    and the negative log-likelihood of the action under the inverse model. No gradient is
    stopped, so both losses shape the policy's encoder.
    """

    needs_embeddings = True

    def __init__(self, config: Config):
        self._forward, self._inverse = ForwardModel(), InverseModel(config.hidden)
        self._widths = (config.hidden, 2 * config.embedding)

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """The parameters of both models; `board` is not looked at."""
        embedding, action = (jnp.zeros((1, width)) for width in self._widths)
        params = {
            "forward": self._forward.init(key, embedding, action),
            "inverse": self._inverse.init(key, embedding, embedding),
        }
        return draw(key, params)

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
        here, there = experience.embedding, experience.next_embedding
        predicted: Any = self._forward.apply(params["forward"], here, experience.action_embedding)
        inferred = self._inverse.apply(params["inverse"], here, there)
        return jnp.square(predicted - there), inferred
