"""E3B: an observation pays by how little its features are like the others of its episode.

Source: Henaff et al. (2022).
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents.curiosity.base import Experience, Params
from agents.curiosity.icm_detached import DetachedICM

RIDGE = 0.1  # lambda of the paper


class E3B(DetachedICM):
    """reward_t = f_{t+1}' C_t^-1 f_{t+1}, with C_t = 0.1 I + the sum over i <= t of f_i f_i'.

    f_i are the features of the episode's observation i, by an encoder of its own, which the
    inverse loss alone shapes: the negative log-likelihood of the action between two of them.
    """

    def init_models(self, key: jax.Array, features: jax.Array) -> Params:
        """The inverse model alone."""
        return {"inverse": self._inverse.init(key, features, features)}

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """The bonus of every next observation."""
        return elliptical_bonus(experience.features)[1:], memory

    def losses(self, params: Params, experience: Experience) -> dict[str, jax.Array]:
        """-log p(action) under the inverse model."""
        features = experience.features
        action: Any = self._inverse.apply(params["inverse"], features[:-1], features[1:])
        return {"inverse_loss": -action.log_prob(experience.episodes.action)}


def elliptical_bonus(features: jax.Array) -> jax.Array:
    """f_t' C_{t-1}^-1 f_t along episodes, C_t = 0.1 I + the sum over i <= t of f_i f_i'.

    The inverse is kept by the Sherman-Morrison formula: with u = C_{t-1}^-1 f_t and the bonus b,

      C_t^-1 = C_{t-1}^-1 - u u' / (1 + b).

    Args:
      features: f32[T, B, F].

    Returns:
      f32[T, B].
    """
    _, batch, width = features.shape

    def visit(inverse: jax.Array, f: jax.Array) -> tuple[jax.Array, jax.Array]:
        u = jnp.einsum("bij,bj->bi", inverse, f)
        bonus = jnp.sum(f * u, axis=-1)
        change = u[:, :, None] * u[:, None, :] / (1 + bonus)[:, None, None]
        return inverse - change, bonus

    start = jnp.broadcast_to(jnp.eye(width) / RIDGE, (batch, width, width))
    _, bonus = jax.lax.scan(visit, start, features)
    return bonus
