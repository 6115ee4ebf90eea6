"""ICM with a separate encoder that only the inverse loss trains.

So the features cannot collapse to easily predicted ones, and the policy's encoder serves only the
policy. Source: own; Burda et al. (2019a) discuss which features to predict.
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents.config import Config
from agents.curiosity.base import Experience, Params
from agents.curiosity.icm import ICM, Models
from agents.networks import make_encoder
from agents.networks.layers import draw
from trap_tube_jax.objects import NUM_DIRECTIONS


class DetachedICM(ICM):
    """Forward and inverse models over a separate encoder's features; reward and losses of `ICM`."""

    detached = True  # as in `Models`

    def __init__(self, config: Config):
        self._encoder: Any = make_encoder(config)
        self._models: Any = Models(config.hidden, self.detached)

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """Draws the parameters of the encoder and of the models."""
        # As in `Agent.init`, only layers of Flax use the folded key.
        features, encoder = self._encoder.init_with_output(jax.random.fold_in(key, 0), board)
        action = _one_hot(jnp.zeros((1, 2), jnp.int32))
        models = self._models.init(key, features, features, action)
        return draw(key, {"encoder": encoder, "models": models})

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Encodes observations with the separate encoder to f32[M, F]."""
        return self._encoder.apply(params["encoder"], observation)

    def predict(self, params: Params, experience: Experience) -> Any:
        """Returns squared errors f32[T, B, F] of predicted features, and the inferred action."""
        features, action = experience.features, _one_hot(experience.episodes.action)
        return self._models.apply(params["models"], features[:-1], features[1:], action)


def _one_hot(action: jax.Array) -> jax.Array:
    """Encodes actions i32[..., 2] as f32[..., 8]."""
    flags = jax.nn.one_hot(action, NUM_DIRECTIONS, dtype=jnp.float32)
    return flags.reshape(*action.shape[:-1], -1)
