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
from agents.networks.layers import dense, init_module, output_dense
from trap_tube_jax.objects import NUM_DIRECTIONS


class Models(nn.Module):
    """A forward model h + dense([h, a]) of h', and an inverse model of one layer and two heads."""

    hidden: int

    @nn.compact
    def __call__(self, h: jax.Array, after: jax.Array, action: jax.Array) -> Any:
        """Returns the squared errors f32[..., H] of predicted h', and the inferred action.

        Args:
          h: f32[..., H], the GRU's output at a step.
          after: f32[..., H], h', its output after the step.
          action: f32[..., E], the embedded action.
        """
        x = nn.swish(dense(self.hidden, name="inverse")(jnp.concatenate([h, after], axis=-1)))
        heads = ("inverse_grasp", "inverse_move")
        logits = [output_dense(NUM_DIRECTIONS, name=name)(x) for name in heads]
        change = output_dense(h.shape[-1], name="forward")(jnp.concatenate([h, action], axis=-1))
        return jnp.square(h + change - after), ActionDistribution(jnp.stack(logits, axis=-2))


class ICM(Curiosity):
    """Forward and inverse models over the policy's own GRU outputs.

    No gradient is stopped, so both losses train the policy's encoder.
    """

    needs_next_hidden = True

    def __init__(self, config: Config):
        self._models: Any = Models(config.hidden)
        self._widths = (config.hidden, config.hidden, 2 * config.embedding)

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """Draws the parameters of both models."""
        inputs = [jnp.zeros((1, width), jnp.float32) for width in self._widths]
        return init_module(self._models, key, *inputs)

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
        """Returns the squared errors f32[B, T, H] of predicted h', and the inferred action."""
        hidden = experience.hidden, experience.next_hidden
        return self._models.apply(params, *hidden, experience.action_embedding)
