"""The agent's network beyond its encoder: recurrent core and heads, and how all are initialised.

The parts are separate because they are evaluated separately: the encoder once per
distinct observation, the core once per step, the heads on whatever is needed.

Source: paper section "Results", agent specification "Network".
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from trap_tube_jax.objects import NUM_DIRECTIONS


def variance_scaling(scale: float) -> nn.initializers.Initializer:
    """Declares the deviation sqrt(scale / fan_in) of a parameter, the same everywhere in it.

    The modules of this package initialise to deviations, not to samples: `draw` turns
    all of them into parameters with a single draw, which compiles many times faster than
    one draw per parameter.
    """

    def init(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> jax.Array:
        del key
        return jnp.full(shape, np.sqrt(scale / np.prod(shape[:-1])), dtype)

    return init


def draw(key: jax.Array, deviations: Any) -> Any:
    """Parameters from a pytree of deviations: normal, truncated at two deviations.

    The draws are rescaled, so that truncation does not lower their deviation.
    """
    leaves, structure = jax.tree.flatten(deviations)
    sizes = [leaf.size for leaf in leaves]
    noise = jax.random.truncated_normal(key, -2, 2, (sum(sizes),)) / TRUNCATED_DEVIATION
    parts = jnp.split(noise, np.cumsum(sizes)[:-1])
    drawn = [leaf * part.reshape(leaf.shape) for leaf, part in zip(leaves, parts, strict=True)]
    return jax.tree.unflatten(structure, drawn)


TRUNCATED_DEVIATION = 0.87962566103423978  # of a standard normal variable cut off at -2 and 2
hidden_init = variance_scaling(2.0)
output_init = variance_scaling(1.0)
dense = functools.partial(nn.Dense, kernel_init=hidden_init)
output_dense = functools.partial(nn.Dense, kernel_init=output_init)


class Outputs(NamedTuple):
    """What the heads say of an embedding.

    Attributes:
      grasp_logits: f32[..., 4].
      move_logits: f32[..., 4].
      value: f32[...].
    """

    grasp_logits: jax.Array
    move_logits: jax.Array
    value: jax.Array


class Core(nn.Module):
    """What the agent remembers: previous action and reward beside the features, and a GRU.

    The GRU is of the "reset after" form, with a bias on either side:
      z, r, n = x W + b_0 and z', r', n' = h R + b_1, split in three;
      h_t = s(z + z') h_tm1 + (1 - s(z + z')) tanh(n + s(r + r') n').

    Attributes:
      hidden: units of the GRU and of the layer before it.
      embedding: units of each action embedding and of the reward's.
    """

    hidden: int
    embedding: int

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
        self.input_kernel = self.param("input_kernel", hidden_init, (self.hidden, gates))
        self.state_kernel = self.param("state_kernel", hidden_init, (self.hidden, gates))
        self.bias = self.param("bias", nn.initializers.zeros, (2, gates))
        self.initial = self.param("initial", nn.initializers.zeros, (self.hidden,))

    def inputs(
        self, features: jax.Array, action_tm1: jax.Array, reward_tm1: jax.Array
    ) -> jax.Array:
        """The GRU's input side, for any number of steps at once.

        Args:
          features: f32[..., F], the encoded observation.
          action_tm1: i32[..., 2], the previous (grasp, move); zeros at the first step.
          reward_tm1: f32[...], the previous reward; 0 at the first step.

        Returns:
          f32[..., 3 * hidden].
        """
        reward = nn.swish(self.reward_embedding(reward_tm1[..., None]))
        parts = [features, self.embed_action(action_tm1), reward]
        x = nn.swish(self.mix(jnp.concatenate(parts, axis=-1)))
        return x @ self.input_kernel + as_row(self.bias[0], x.ndim)

    def embed_action(self, action: jax.Array) -> jax.Array:
        """The embeddings f32[..., 2 * embedding] of an action i32[..., 2]."""
        grasp = self.grasp_embedding(action[..., 0])
        return jnp.concatenate([grasp, self.move_embedding(action[..., 1])], axis=-1)

    def initial_state(self, *batch: int) -> jax.Array:
        """The learned state before the first step, f32[*batch, hidden]."""
        return jnp.broadcast_to(self.initial, (*batch, self.hidden))

    def advance(self, state: jax.Array, inputs: jax.Array) -> jax.Array:
        """One step of the GRU: f32[..., hidden], f32[..., 3 * hidden] -> f32[..., hidden]."""
        recurrent = state @ self.state_kernel + as_row(self.bias[1], state.ndim)
        update_x, reset_x, candidate_x = jnp.split(inputs, 3, axis=-1)
        update_h, reset_h, candidate_h = jnp.split(recurrent, 3, axis=-1)
        update = nn.sigmoid(update_x + update_h)
        reset = nn.sigmoid(reset_x + reset_h)
        candidate = jnp.tanh(candidate_x + reset * candidate_h)
        return update * state + (1 - update) * candidate

    def unroll(self, inputs: jax.Array) -> jax.Array:
        """The GRU over time from the initial state: f32[T, B, 3 * hidden] -> f32[T, B, hidden]."""

        def body(state: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
            state = self.advance(state, x)
            return state, state

        return jax.lax.scan(body, self.initial_state(inputs.shape[1]), inputs)[1]


class Heads(nn.Module):
    """Grasp logits, move logits and value, each one layer from the embedding."""

    @nn.compact
    def __call__(self, embedding: jax.Array) -> Outputs:
        """Maps f32[..., hidden] to `Outputs`."""
        return Outputs(
            grasp_logits=output_dense(NUM_DIRECTIONS, name="grasp")(embedding),
            move_logits=output_dense(NUM_DIRECTIONS, name="move")(embedding),
            value=output_dense(1, name="value")(embedding)[..., 0],
        )


def as_row(vector: jax.Array, ndim: int) -> jax.Array:
    """f32[1, ..., 1, C], to add f32[C] along the last axis."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))
