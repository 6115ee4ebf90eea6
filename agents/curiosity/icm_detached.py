"""ICM with an encoder of its own, which the inverse loss alone trains.

The forward model sees the features but does not move them, so they cannot collapse to what is
easily predicted, and the policy's encoder serves the policy only.

Source: own; Burda et al. (2019a) discuss which features to predict.
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents.config import Config
from agents.curiosity.base import Experience, Params
from agents.curiosity.icm import ICM
from agents.curiosity.models import ForwardModel, InverseFeatures
from agents.networks import make_encoder
from agents.networks.actions import ActionDistribution
from agents.networks.layers import init_module
from trap_tube_jax.objects import NUM_DIRECTIONS


class Models(InverseFeatures):
    """An encoder, and the two models over its features.

    Attributes:
      detached: whether the forward model's error stops at the features.
    """

    detached: bool = True

    def setup(self) -> None:
        """Declares the two models."""
        super().setup()
        self.forward = ForwardModel()

    def __call__(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, observation: jax.Array, next_observation: jax.Array, action: jax.Array
    ) -> tuple[jax.Array, ActionDistribution]:
        """All of it on single steps: u8[M, 12, 12, N] twice and i32[M, 2]; see `compare`."""
        features: Any = self.encoder(observation)
        next_features: Any = self.encoder(next_observation)
        return self.compare(features, next_features, action)

    def compare(
        self, features: jax.Array, next_features: jax.Array, action: jax.Array
    ) -> tuple[jax.Array, ActionDistribution]:
        """The squared errors f32[..., F] of the predicted features; the inferred action."""
        one_hot = jax.nn.one_hot(action, NUM_DIRECTIONS)
        seen = features, next_features
        here, there = jax.lax.stop_gradient(seen) if self.detached else seen
        predicted = self.forward(here, one_hot.reshape(*action.shape[:-1], -1))
        return jnp.square(predicted - there), self.inverse(features, next_features)


class DetachedICM(ICM):
    """Forward and inverse models over features of its own; reward and losses are those of `ICM`.

    Attributes:
      detached: as in `Models`.
    """

    needs_embeddings = False
    detached = True

    def __init__(self, config: Config):
        self._models = Models(config.hidden, make_encoder(config), self.detached)

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """The parameters of the encoder and of both models."""
        return init_module(self._models, key, board, board, jnp.zeros((1, 2), jnp.int32))

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Features of its own encoder, f32[M, F]."""
        features: Any = self._models.apply(
            params, observation, method=lambda models, x: models.encoder(x)
        )
        return features

    def predict(self, params: Params, experience: Experience) -> Any:
        """The squared errors f32[T, B, F] of the predicted features, and the inferred action."""
        features, action = experience.features, experience.episodes.action
        return self._models.apply(
            params, features[:-1], features[1:], action, method=Models.compare
        )
