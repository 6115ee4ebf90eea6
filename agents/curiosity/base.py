"""The interface of intrinsic rewards.

To add one, subclass `Curiosity`, override what it needs, and register it: agents/extending.md.

Source: agents/agent.md, "Curiosity".
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes

Params = Any


class Experience(NamedTuple):
    """Episodes, and what the networks compute from them.

    Attributes:
      episodes: B episodes of T steps.
      features: f32[B, T + 1, F], the observations encoded by `Curiosity.encode`.
      hidden: f32[B, T, H], the GRU's output h at the step.
      next_hidden: f32[B, T, H], h', its output after the step, in a second pass; None unless
        the curiosity `needs_next_hidden`.
      action_embedding: f32[B, T, E], the policy's embedding of the action.
    """

    episodes: Episodes
    features: jax.Array
    hidden: jax.Array
    next_hidden: jax.Array | None
    action_embedding: jax.Array


class Curiosity:
    """An intrinsic reward. This base class pays 0 and has no parameters and no memory.

    All methods are pure functions of arrays. Attributes are settings and modules, never arrays.

    Attributes:
      needs_next_hidden: whether rewards or losses read `Experience.next_hidden`.
    """

    needs_next_hidden = False

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """Draws parameters, trained together with the policy's; {} if there are none.

        `board` is an observation u8[1, 12, 12, N], for `networks.layers.init_module`.
        """
        return {}

    def memory(self) -> Any:
        """Returns the first memory, carried from one iteration to the next; () if there is none.

        Several devices average it, so its arrays must then be floats.
        """
        return ()

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Encodes observations u8[M, 12, 12, N] to features f32[M, F]; F = 0 if there are none."""
        return jnp.zeros((len(observation), 0), jnp.float32)

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """Returns the reward f32[B, T] of every step, before scaling, and the new memory.

        Values after an episode's end are ignored.
        """
        return jnp.zeros_like(experience.episodes.reward), memory

    def losses(self, params: Params, experience: Experience) -> dict[str, jax.Array]:
        """Returns terms of the loss, f32[B, T] each; {} if nothing is trained.

        Names end in `_loss`. Values must be finite after an episode's end, too.
        """
        return {}
