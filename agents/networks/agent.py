"""The policy network as pure functions of its parameters: encoder, recurrent core, heads."""

from typing import Any

import chex
import jax
import jax.numpy as jnp

from agents.config import Config
from agents.networks import make_encoder
from agents.networks.actions import ActionDistribution
from agents.networks.core import Core, Heads
from agents.networks.layers import assert_only_params, draw
from agents.registry import contract
from trap_tube_jax.objects import BOARD_SIZE

Params = dict[str, Any]

PARTS = ("encoder", "core", "heads")  # the policy network's parameters


class Agent:
    """Functions of the policy network; their parameters are a dictionary of `PARTS`.

    `scan_unroll` is passed to `Core`.
    """

    def __init__(self, config: Config, scan_unroll: int = 1):
        self.config = config
        # Typed as anything, because `apply` returns the results of any method.
        self.encoder: Any = make_encoder(config)
        self.core: Any = Core(
            config.hidden,
            config.embedding,
            config.recurrent,
            config.previous_inputs,
            scan_unroll,
        )
        self.heads: Any = Heads(config.num_value_heads)

    def init(self, key: jax.Array) -> Params:
        """Draws the parameters."""
        board = jnp.zeros((1, BOARD_SIZE, BOARD_SIZE, self.config.num_features), jnp.uint8)
        with contract("encoder", self.config.encoder):
            # Only Flax's own layers, in a registered encoder, use the folded key; see `draw`.
            encoder = self.encoder.init(jax.random.fold_in(key, 0), board)
            assert_only_params(encoder)
            features = self.encoder.apply(encoder, board)
            chex.assert_shape(features, (1, None))  # [M, F]
            chex.assert_axis_dimension_gt(features, 1, 0)
            chex.assert_type(features, jnp.float32)
        state = jnp.zeros((1, self.config.hidden), jnp.float32)
        action = jnp.zeros((1, 2), jnp.int32)
        reward = jnp.zeros(1, jnp.float32)
        params = {
            "encoder": encoder,
            "core": self.core.init(key, state, features, action, reward),
            "heads": self.heads.init(key, state),
        }
        return draw(key, params)

    def encode(self, params: Params, observation: jax.Array) -> jax.Array:
        """Encodes observations u8[M, 12, 12, N] to f32[M, F]; reads only `params["encoder"]`."""
        with contract("encoder", self.config.encoder):
            return self.encoder.apply(params["encoder"], observation)

    def initial_state(self, params: Params, batch: int) -> jax.Array:
        """Returns the GRU's state f32[batch, hidden] before the first step."""
        return self.core.apply(params["core"], batch, method=Core.initial_state)

    def step(
        self,
        params: Params,
        state: jax.Array,
        features: jax.Array,
        action_tm1: jax.Array,
        reward_tm1: jax.Array,
    ) -> jax.Array:
        """Returns the GRU's state f32[..., hidden] after a step; see `Core.inputs`."""
        return self.core.apply(params["core"], state, features, action_tm1, reward_tm1)

    def unroll(
        self,
        params: Params,
        features: jax.Array,
        action: jax.Array,
        reward: jax.Array,
        *,
        with_next: bool = False,
    ) -> tuple[jax.Array, jax.Array | None]:
        """Returns the GRU's outputs h at every step, and h' after it; see `Core.unroll`."""
        return self.core.apply(
            params["core"], features, action, reward, with_next, method=Core.unroll
        )

    def policy_and_value(
        self, params: Params, state: jax.Array
    ) -> tuple[ActionDistribution, jax.Array]:
        """Returns actions and values f32[..., V] at states f32[..., hidden] of the GRU."""
        return self.heads.apply(params["heads"], state)

    def embed_action(self, params: Params, action: jax.Array) -> jax.Array:
        """Embeds actions i32[..., 2] to f32[..., 2 * embedding]."""
        return self.core.apply(params["core"], action, method=Core.embed_action)
