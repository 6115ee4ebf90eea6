"""Random network distillation: the error in predicting a fixed random encoder.

Source: Burda et al. (2019).
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.config import Config
from agents.curiosity.base import Curiosity, Experience, Params
from agents.networks import make_encoder
from agents.networks.layers import dense, init_module, output_dense
from agents.registry import contract


class Models(nn.Module):
    """A fixed random target, and its predictor: an encoder, a layer of `hidden` units, an output.

    Both encoders map u8[M, 12, 12, N] to f32[M, F].
    """

    hidden: int
    target: nn.Module
    predictor: nn.Module

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Returns the difference of prediction and target, f32[M, F]."""
        target: Any = jax.lax.stop_gradient(self.target(observation))
        x = nn.swish(dense(self.hidden, name="hidden")(self.predictor(observation)))
        return output_dense(target.shape[-1], name="output")(x) - target


class RND(Curiosity):
    """reward: the squared error at the next observation, summed over units; loss: its mean."""

    def __init__(self, config: Config):
        self._encoder = config.encoder
        self._models = Models(config.hidden, make_encoder(config), make_encoder(config))

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """Draws the parameters of target and predictor; the target's get no gradient."""
        params = init_module(self._models, key, board)
        found = [jax.tree.structure(params["params"].get(name)) for name in ("target", "predictor")]
        with contract("encoder", self._encoder):
            assert found[0] == found[1], "two encoders share a module; build all modules anew"
        return params

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Returns the difference of prediction and target, f32[M, F]."""
        difference: Any = self._models.apply(params, observation)
        return difference

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """Returns the sum over units of the squared errors at the next observation."""
        return jnp.sum(jnp.square(experience.features[:, 1:]), axis=-1), memory

    def losses(self, params: Params, experience: Experience) -> dict[str, jax.Array]:
        """Returns the mean over units of the same errors."""
        return {"forward_loss": jnp.mean(jnp.square(experience.features[:, 1:]), axis=-1)}
