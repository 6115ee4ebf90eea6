"""ICM with an encoder of its own, which the inverse loss alone trains.

So the features cannot collapse to easily predicted ones, and the policy's encoder serves the
policy only. Source: own; Burda et al. (2019a) discuss which features to predict.
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents.config import Config
from agents.curiosity.base import Experience, Params
from agents.curiosity.icm import ICM
from agents.networks import make_encoder
from agents.networks.layers import draw
from trap_tube_jax.objects import NUM_DIRECTIONS


class DetachedICM(ICM):
    """Forward and inverse models over features of its own; reward and losses are those of `ICM`.

    If `detached`, no gradient of the forward model's error reaches the features.
    """

    needs_next_embedding = False
    detached = True

    def __init__(self, config: Config):
        super().__init__(config)
        self._encoder = make_encoder(config)

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """Draws the parameters of the encoder and of the models."""
        # As in `Agent.init`, only layers of Flax use the folded key.
        features, encoder = self._encoder.init_with_output(jax.random.fold_in(key, 0), board)
        return draw(key, {"encoder": encoder, **self.init_models(key, features)})

    def init_models(self, key: jax.Array, features: jax.Array) -> Params:
        """Returns parameters of the models on features f32[1, F], for `draw`."""
        action = _one_hot(jnp.zeros((1, 2), jnp.int32))
        return {
            "forward": self._forward.init(key, features, action),
            "inverse": self._inverse.init(key, features, features),
        }

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Encodes observations by its own encoder to f32[M, F]."""
        features: Any = self._encoder.apply(params["encoder"], observation)
        return features

    def predict(self, params: Params, experience: Experience) -> Any:
        """Returns squared errors f32[T, B, F] of predicted features, and the inferred action."""
        action = _one_hot(experience.episodes.action)
        seen = experience.features[:-1], experience.features[1:]
        here, there = jax.lax.stop_gradient(seen) if self.detached else seen
        predicted: Any = self._forward.apply(params["forward"], here, action)
        error = jnp.square(predicted - there)
        return error, self._inverse.apply(params["inverse"], *seen)


def _one_hot(action: jax.Array) -> jax.Array:
    """Encodes actions i32[..., 2] as f32[..., 8]."""
    flags = jax.nn.one_hot(action, NUM_DIRECTIONS, dtype=jnp.float32)
    return flags.reshape(*action.shape[:-1], -1)
