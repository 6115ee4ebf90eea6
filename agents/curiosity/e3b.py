"""E3B: rewards observations whose features differ from the episode's earlier features.

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

    f_i are features of the episode's observation i, by an encoder that the inverse loss trains.
    """

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """Returns the bonus of every next observation."""
        return elliptical_bonus(experience.features)[1:], memory

    def losses(self, params: Params, experience: Experience) -> dict[str, jax.Array]:
        """Returns -log p(action) under the inverse model; the forward model is not trained."""
        return {"inverse_loss": super().losses(params, experience)["inverse_loss"]}


def elliptical_bonus(features: jax.Array) -> jax.Array:
    """Computes f_t' C_{t-1}^-1 f_t, f32[T, B], for features f32[T, B, F] of episodes.

    With u = C_{t-1}^-1 f_t and the bonus b, C_t^-1 = C_{t-1}^-1 - u u' / (1 + b), by Sherman and
    Morrison.
    """
    _, batch, width = features.shape

    def visit(inverse: jax.Array, f: jax.Array) -> tuple[jax.Array, jax.Array]:
        u = jnp.einsum("bij,bj->bi", inverse, f)
        bonus = jnp.sum(f * u, axis=-1)
        change = u[:, :, None] * u[:, None, :] / (1 + bonus)[:, None, None]
        return inverse - change, bonus

    start = jnp.eye(width, dtype=jnp.float32) / RIDGE
    _, bonus = jax.lax.scan(visit, jnp.broadcast_to(start, (batch, width, width)), features)
    return bonus
