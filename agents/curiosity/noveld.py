"""NovelD: the reward of a step from a familiar observation to a novel one.

Source: Zhang et al. (2021); novelty by Burda et al. (2019).
"""

from typing import Any

import jax
import jax.numpy as jnp

from agents.curiosity.base import Experience, Params
from agents.curiosity.first_visits import first_visits
from agents.curiosity.rnd import RND

ALPHA = 0.5  # as in the paper


class NovelD(RND):
    """reward_t = max(n(o_{t+1}) - 0.5 n(o_t), 0), if o_{t+1} is new in its episode, else 0.

    n is the Euclidean norm of the prediction error of `rnd`; the loss is `rnd`'s.
    """

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """Returns the rise of novelty, at first visits."""
        novelty = jnp.linalg.norm(experience.features, axis=-1)
        rise = jnp.maximum(novelty[:, 1:] - ALPHA * novelty[:, :-1], 0.0)
        return rise * first_visits(experience.episodes.position_ids())[:, 1:], memory
