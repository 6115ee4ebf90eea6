"""RIDE: a step pays by how much it changes features of the observation.

Source: Raileanu and Rocktaeschel (2020).
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents.acting.identity import visits
from agents.curiosity.base import Experience, Params
from agents.curiosity.icm_detached import DetachedICM


class RIDE(DetachedICM):
    """reward_t = |f(o_{t+1}) - f(o_t)| / sqrt(N(o_{t+1})), with the Euclidean norm.

    N counts the visits of the episode so far, this one included. f is an encoder of its own,
    which both the forward and the inverse loss shape; the losses are those of `ICM`.
    """

    detached = False

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """The change of the features, over the root of the visits."""
        change = jnp.linalg.norm(jnp.diff(experience.features, axis=0), axis=-1)
        return change / jnp.sqrt(visits(experience.observation_id)[1:]), memory
