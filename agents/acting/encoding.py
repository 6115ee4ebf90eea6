"""Encodes the observations of episodes, while they are played and afterwards.

`Encoding` applies the encoder to every observation. `rollout` and the learner take an encoding as
an argument, so a faster one can replace it; `agents.ppo.machine` chooses.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import trap_tube_jax as tt
from agents.acting.episodes import Episodes
from agents.networks.agent import Agent, Params

# Maps (params, observations u8[M, 12, 12, N]) to features f32[M, F].
EncodeFn = Callable[[Params, jax.Array], jax.Array]


def no_features(params: Params, observation: jax.Array) -> jax.Array:
    """Encodes observations u8[M, 12, 12, N] to nothing, f32[M, 0]."""
    del params
    return jnp.zeros((len(observation), 0), jnp.float32)


class Encoding:
    """Encodes every observation by itself.

    Attributes:
      name: the path's name, for people.
      agent: functions of the policy network.
      encode_for_curiosity: encoder of the curiosity, given its parameters.
    """

    name = "plain"

    def __init__(self, agent: Agent, encode_for_curiosity: EncodeFn = no_features):
        self.agent = agent
        self.encode_for_curiosity = encode_for_curiosity

    def start(self, params: Params, initial: tt.State, num_steps: int) -> Any:
        """Returns the memory with which `step` begins B episodes of `num_steps` steps."""
        del params, initial, num_steps
        return ()

    def step(
        self, params: Params, state: tt.State, time: jax.Array, memory: Any
    ) -> tuple[jax.Array, Any]:
        """Returns the policy's features f32[B, F] of B states at `time` i32[], and the memory."""
        del time
        return self.agent.encode(params, jax.vmap(tt.observe)(state)), memory

    def encode_episodes(self, params: Params, episodes: Episodes) -> tuple[jax.Array, jax.Array]:
        """Encodes all observations of episodes; differentiable by `params`.

        Returns:
          f32[B, T + 1, F] for the policy and f32[B, T + 1, F'] for the curiosity.
        """
        observation = episodes.observations()
        rows = jax.lax.collapse(observation, 0, 2)
        features = (
            self.agent.encode(params, rows),
            self.encode_for_curiosity(params["curiosity"], rows),
        )
        return jax.tree.map(lambda x: x.reshape(*observation.shape[:2], -1), features)
