"""The recurrent core and the heads of the policy network.

The encoder is separate because it runs once per distinct observation, the core once per step, and
the heads where an action or a value is needed.

Source: paper, section "Results"; agents/agent.md, "Network".
"""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from agents.networks.actions import ActionDistribution
from agents.networks.layers import as_row, dense, hidden_init, output_dense
from trap_tube_jax.objects import NUM_DIRECTIONS


class Core(nn.Module):
    """Mixes features, previous action and previous reward, and feeds them to a GRU.

    The GRU is of the "reset after" form, with two biases:
      z, r, n = x W + b_0 and z', r', n' = h R + b_1, each split in three;
      h_t = s(z + z') h_tm1 + (1 - s(z + z')) tanh(n + s(r + r') n').

    Attributes:
      hidden: units of the GRU.
      embedding: units of each embedding of actions and reward.
      recurrent: keeps the state between steps.
      previous_inputs: reads the previous action and reward, besides the features.
      scan_unroll: steps of `unroll` per iteration of its loop; affects only speed.
    """

    hidden: int
    embedding: int
    recurrent: bool = True
    previous_inputs: bool = True
    scan_unroll: int = 1

    def setup(self) -> None:
        """Declares the parameters."""
        embed = functools.partial(
            nn.Embed, NUM_DIRECTIONS, self.embedding, embedding_init=hidden_init
        )
        self.grasp_embedding = embed()
        self.move_embedding = embed()
        self.reward_embedding = dense(self.embedding)
        self.mix = dense(self.hidden)
        gates = 3 * self.hidden
        self.input_kernel: Any = self.param("input_kernel", hidden_init, (self.hidden, gates))
        self.state_kernel: Any = self.param("state_kernel", hidden_init, (self.hidden, gates))
        self.bias = self.param("bias", nn.initializers.zeros, (2, gates), jnp.float32)
        self.initial = self.param("initial", nn.initializers.zeros, (self.hidden,), jnp.float32)

    def __call__(
        self, state: jax.Array, features: jax.Array, action_tm1: jax.Array, reward_tm1: jax.Array
    ) -> jax.Array:
        """Returns the state f32[..., hidden] after one step."""
        return self.advance(state, self.inputs(features, action_tm1, reward_tm1))

    def inputs(
        self, features: jax.Array, action_tm1: jax.Array, reward_tm1: jax.Array
    ) -> jax.Array:
        """Computes x W + b_0, f32[..., 3 * hidden], for any number of steps at once.

        Args:
          features: f32[..., F], the encoded observation.
          action_tm1: i32[..., 2], the previous (grasp, move); zeros at the first step.
          reward_tm1: f32[...], the previous reward; 0 at the first step.
        """
        action = self.embed_action(action_tm1)  # in any case, since other networks read it
        parts = [features]
        if self.previous_inputs:
            parts += [action, nn.swish(self.reward_embedding(reward_tm1[..., None]))]
        x = nn.swish(self.mix(jnp.concatenate(parts, axis=-1)))
        return x @ self.input_kernel + as_row(self.bias[0], x.ndim)

    def embed_action(self, action: jax.Array) -> jax.Array:
        """Embeds actions i32[..., 2] to f32[..., 2 * embedding]."""
        grasp = self.grasp_embedding(action[..., 0])
        return jnp.concatenate([grasp, self.move_embedding(action[..., 1])], axis=-1)

    def initial_state(self, *batch: int) -> jax.Array:
        """Returns the learned state before the first step, f32[*batch, hidden]."""
        return jnp.broadcast_to(self.initial, (*batch, self.hidden))

    def advance(self, state: jax.Array, inputs: jax.Array) -> jax.Array:
        """Returns the state f32[..., hidden] after a step with inputs f32[..., 3 * hidden]."""
        if not self.recurrent:
            state = self.initial_state(*state.shape[:-1])
        recurrent = state @ self.state_kernel + as_row(self.bias[1], state.ndim)
        update_x, reset_x, candidate_x = jnp.split(inputs, 3, axis=-1)
        update_h, reset_h, candidate_h = jnp.split(recurrent, 3, axis=-1)
        update = nn.sigmoid(update_x + update_h)
        reset = nn.sigmoid(reset_x + reset_h)
        candidate = jnp.tanh(candidate_x + reset * candidate_h)
        return update * state + (1 - update) * candidate

    def unroll(
        self, features: jax.Array, action: jax.Array, reward: jax.Array, with_next: bool
    ) -> tuple[jax.Array, jax.Array | None]:
        """Runs the GRU over episodes, from the initial state.

        Args:
          features: f32[B, T + 1, F], the encoded observations.
          action: i32[B, T, 2], (grasp, move).
          reward: f32[B, T].
          with_next: computes h', too.

        Returns:
          h at every step, f32[B, T, hidden], and h' after every step, or None. h' starts from the
          initial state at the second observation (agents/agent.md, "Curiosity").
        """
        action_tm1 = jnp.pad(action, ((0, 0), (1, 0), (0, 0)))
        reward_tm1 = jnp.pad(reward, ((0, 0), (1, 0)))
        inputs = self.inputs(*(x.swapaxes(0, 1) for x in (features, action_tm1, reward_tm1)))
        batch = inputs.shape[1]
        parts = [inputs[:-1], inputs[1:]] if with_next else [inputs[:-1]]
        inputs = jnp.concatenate(parts, axis=1)  # one scan for both, over twice the batch

        def step(state: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
            state = self.advance(state, x)
            return state, state

        start = self.initial_state(inputs.shape[1])
        _, h = jax.lax.scan(step, start, inputs, unroll=self.scan_unroll)
        h = h.swapaxes(0, 1)
        return h[:batch], (h[batch:] if with_next else None)


class Heads(nn.Module):
    """Grasp logits, move logits and V values, each one layer from the GRU's state."""

    num_values: int = 1

    @nn.compact
    def __call__(self, state: jax.Array) -> tuple[ActionDistribution, jax.Array]:
        """Maps f32[..., hidden] to the distribution of actions and the values f32[..., V]."""
        logits = [output_dense(NUM_DIRECTIONS, name=name)(state) for name in ("grasp", "move")]
        value = output_dense(self.num_values, name="value")(state)
        return ActionDistribution(jnp.stack(logits, axis=-2)), value
