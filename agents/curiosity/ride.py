"""RIDE: the reward of a step is its change of the observation's features.

Source: Raileanu and Rocktaeschel (2020).
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents.curiosity.base import Experience, Params
from agents.curiosity.icm_detached import DetachedICM
from agents.curiosity.visits import visits


class RIDE(DetachedICM):
    """reward_t = |f(o_{t+1}) - f(o_t)| / sqrt(N(o_{t+1})), with the Euclidean norm.

    N counts the visits of the episode so far, this one included. f is an encoder of its own,
    trained by both the forward and the inverse loss; the losses are those of `ICM`.
    """

    detached = False

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """Returns the change of the features, divided by the root of the visits."""
        change = jnp.linalg.norm(jnp.diff(experience.features, axis=0), axis=-1)
        return change / jnp.sqrt(visits(experience.episodes.observation_id)[1:]), memory
