"""The policy network as pure functions of its parameters: encoder, recurrent core, heads."""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.config import Config
from agents.networks import make_encoder
from agents.networks.core import Core, Heads, Outputs
from agents.networks.layers import draw
from agents.networks.windows import encode_rows
from trap_tube_jax.objects import BOARD_SIZE

Params = dict[str, Any]

PARTS = ("encoder", "core", "heads")  # of the parameters of the policy network


class Agent:
    """The functions of the policy network; holds its modules, never parameters.

    Parameters are a dictionary of `PARTS`; other entries are ignored.

    Attributes:
      config: the settings. Whoever plays heeds `align_to_food` and `chunk`, which are not done here.
    """

    def __init__(self, config: Config):
        self.encoder = make_encoder(config)
        self.core = Core(config.hidden, config.embedding, config.recurrent)
        self.heads = Heads(config.num_value_heads)
        self.config = config

    @functools.cached_property
    def width(self) -> int:
        """F, how many features an observation is encoded to."""

        def encode() -> Any:
            return self.encoder.init_with_output(jax.random.key(0), self._board())[0]

        return jax.eval_shape(encode).shape[-1]

    def init(self, key: jax.Array) -> Params:
        """Fresh parameters."""
        # Layers of Flax in an encoder of your own draw with this key; those here leave that to
        # `draw` and use no key.
        encoder_key = jax.random.fold_in(key, 0)
        features, encoder = self.encoder.init_with_output(encoder_key, self._board())
        state = jnp.zeros((1, self.config.hidden))
        action, reward = jnp.zeros((1, 2), jnp.int32), jnp.zeros(1)
        params = {
            "encoder": encoder,
            "core": self.core.init(key, state, features, action, reward),
            "heads": self.heads.init(key, state),
        }
        return draw(key, params)

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Features f32[M, F] of observations u8[M, 12, 12, N]; reads `params["encoder"]`."""
        return _apply(self.encoder, params["encoder"], observation)

    def encode_rows(self, params: Params, observation: jax.Array, remembered: Any = None) -> Any:
        """The same by the fast path; a row function, see `chunks.RowFn`."""
        return encode_rows(self.encoder, params["encoder"], observation, remembered)

    def step(
        self,
        params: Params,
        state: jax.Array,
        features: jax.Array,
        action_tm1: jax.Array,
        reward_tm1: jax.Array,
    ) -> jax.Array:
        """The GRU's state f32[..., hidden] after a step.

        Args:
          params: the parameters.
          state: f32[..., hidden], the state before it.
          features: f32[..., F], the encoded observation.
          action_tm1: i32[..., 2], the previous (grasp, move); zeros at the first step.
          reward_tm1: f32[...], the previous reward; 0 at the first step.
        """
        return _apply(self.core, params["core"], state, features, action_tm1, reward_tm1)

    def initial_state(self, params: Params, batch: int) -> jax.Array:
        """The GRU's state f32[batch, hidden] before the first step."""
        return _apply(self.core, params["core"], batch, method=Core.initial_state)

    def policy_and_value(self, params: Params, embedding: jax.Array) -> Outputs:
        """Distribution of actions and value of an embedding f32[..., hidden]."""
        return _apply(self.heads, params["heads"], embedding)

    def embed_action(self, params: Params, action: jax.Array) -> jax.Array:
        """The embeddings f32[..., E] of actions i32[..., 2]."""
        return _apply(self.core, params["core"], action, method=Core.embed_action)

    def unroll(
        self, params: Params, features: jax.Array, action: jax.Array, reward: jax.Array
    ) -> jax.Array:
        """The GRU's outputs h at every step, f32[T, B, hidden].

        Args:
          params: the parameters.
          features: f32[T + 1, B, F].
          action: i32[T, B, 2].
          reward: f32[T, B].
        """
        inputs = self._unroll_inputs(params, features, action, reward)[:-1]
        return _apply(self.core, params["core"], inputs, method=Core.unroll)

    def unroll_both(
        self, params: Params, features: jax.Array, action: jax.Array, reward: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The GRU's outputs h at every step and h' after it, each f32[T, B, hidden].

        h' starts from the initial state at the second observation, with the action and reward
        just taken as the previous ones (agents/agent.md, "Curiosity").

        Args:
          params: the parameters.
          features: f32[T + 1, B, F].
          action: i32[T, B, 2].
          reward: f32[T, B].
        """
        inputs = self._unroll_inputs(params, features, action, reward)
        both = jnp.concatenate([inputs[:-1], inputs[1:]], axis=1)
        embeddings = _apply(self.core, params["core"], both, method=Core.unroll)
        now, after = jnp.split(embeddings, 2, axis=1)
        return now, after

    def _board(self) -> jax.Array:
        """An observation, which stands for any other."""
        return jnp.zeros((1, BOARD_SIZE, BOARD_SIZE, self.config.num_features), jnp.uint8)

    def _unroll_inputs(
        self, params: Params, features: jax.Array, action: jax.Array, reward: jax.Array
    ) -> jax.Array:
        """The GRU's inputs at all observations, f32[T + 1, B, 3 * hidden]."""
        action_tm1 = jnp.concatenate([jnp.zeros_like(action[:1]), action])
        reward_tm1 = jnp.concatenate([jnp.zeros_like(reward[:1]), reward])
        return _apply(
            self.core, params["core"], features, action_tm1, reward_tm1, method=Core.inputs
        )


def num_parameters(params: Params) -> int:
    """The number of scalars in `params`."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def _apply(module: nn.Module, *args: Any, **kwargs: Any) -> Any:
    """`module.apply`, whose static type says nothing of what it returns."""
    return module.apply(*args, **kwargs)
