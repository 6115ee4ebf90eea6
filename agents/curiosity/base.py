"""What an intrinsic reward is: one object with a few functions.

To add one, subclass `Curiosity`, override what it needs, and register it: agents/extending.md.

Source: agents/agent.md, "Curiosity".
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from agents.acting.episodes import Episodes

Params = Any


class Experience(NamedTuple):
    """What a curiosity may look at: episodes, and what the policy network made of them.

    Step t leads from observation t to observation t + 1.

    Attributes:
      episodes: B episodes of T steps.
      observation_id: i32[T + 1, B], equal only for equal observations.
      features: f32[T + 1, B, F], what `Curiosity.encode` makes of the observations.
      embedding: f32[T, B, H], the GRU's output h at the step; None unless `needs_embeddings`.
      next_embedding: f32[T, B, H], h', the GRU's output after the step; likewise.
      action_embedding: f32[T, B, E], the policy's embedding of the action; likewise.
    """

    episodes: Episodes
    observation_id: jax.Array
    features: jax.Array
    embedding: Any = None
    next_embedding: Any = None
    action_embedding: Any = None


class Curiosity:
    """An intrinsic reward. This base class pays nothing, trains nothing, remembers nothing.

    All methods are pure functions of arrays.

    Attributes:
      needs_embeddings: whether the experience is to hold the embeddings, which cost a second
        pass of the GRU.
    """

    needs_embeddings = False

    def init(self, key: jax.Array, board: jax.Array) -> Params:
        """Parameters that are trained beside the policy's; {} if there are none.

        Args:
          key: PRNG key. `networks.layers.init_module` initialises modules of the layers there.
          board: u8[1, 12, 12, N], an observation, for its shape.
        """
        return {}

    def memory(self) -> Any:
        """Returns the first memory, carried from one iteration to the next; () if there is none.

        Several devices average it, so its arrays must then be floats.
        """
        return ()

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Features of its own, f32[M, F], of observations u8[M, 12, 12, N]; F = 0 if none."""
        return jnp.zeros((len(observation), 0))

    def reward(self, params: Params, memory: Any, experience: Experience) -> tuple[jax.Array, Any]:
        """The intrinsic reward f32[T, B] of every step, before scaling, and the new memory.

        Values after an episode's end are ignored, whatever they are.
        """
        return jnp.zeros_like(experience.episodes.reward), memory

    def losses(self, params: Params, experience: Experience) -> dict[str, jax.Array]:
        """Terms of the loss by name, f32[T, B] each, finite also after an episode's end.

        {} if nothing is trained. Names end in `_loss`.
        """
        return {}
