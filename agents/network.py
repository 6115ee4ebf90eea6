"""The agent's network: convolutional encoder, recurrent core, heads.

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

from trap_tube_jax.objects import BOARD_SIZE, NUM_DIRECTIONS


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


class Encoder(nn.Module):
    """Observation to features: two convolutions, two residual blocks, global max pool.

    Batched, as convolutions are. Every convolution pads to keep the size; a 2x2 one
    pads below and to the right.

    Attributes:
      filters: channels of the first convolution, and of all later ones.
    """

    filters: tuple[int, int]

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """Encodes u8[M, 12, 12, N] to f32[M, filters[1]]."""
        x = scaled_with_coordinates(observation)
        x = nn.swish(Conv(self.filters[0], 2, name="conv1")(x))
        x = nn.swish(Conv(self.filters[1], 2, name="conv2")(x))
        x = ResidualBlock(name="block1")(max_pool(x))
        x = ResidualBlock(name="block2")(max_pool(x))
        return jnp.max(x, axis=(1, 2))


class ResidualBlock(nn.Module):
    """x + conv3x3(swish(conv3x3(swish(x)))), channels kept."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps f32[M, H, W, C] to f32[M, H, W, C]."""
        channels = x.shape[-1]
        y = Conv(channels, 3, name="conv1")(nn.swish(x))
        return x + Conv(channels, 3, name="conv2")(nn.swish(y))


class Conv(nn.Module):
    """A square convolution, stride 1, size kept, written as one matrix product.

    XLA's CPU convolutions are slow backwards; the product of the gathered patches with
    the kernel, [M * H * W, k * k * C_in] times [k * k * C_in, C_out], is not.

    Attributes:
      features: output channels.
      size: the kernel's height and width.
    """

    features: int
    size: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps f32[M, H, W, C_in] to f32[M, H, W, features]."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", hidden_init, shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        y = patches(x, self.size) @ kernel.reshape(-1, self.features)
        return y + _as_row(bias, y.ndim)


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
        return x @ self.input_kernel + _as_row(self.bias[0], x.ndim)

    def embed_action(self, action: jax.Array) -> jax.Array:
        """The embeddings f32[..., 2 * embedding] of an action i32[..., 2]."""
        grasp = self.grasp_embedding(action[..., 0])
        return jnp.concatenate([grasp, self.move_embedding(action[..., 1])], axis=-1)

    def initial_state(self, *batch: int) -> jax.Array:
        """The learned state before the first step, f32[*batch, hidden]."""
        return jnp.broadcast_to(self.initial, (*batch, self.hidden))

    def advance(self, state: jax.Array, inputs: jax.Array) -> jax.Array:
        """One step of the GRU: f32[..., hidden], f32[..., 3 * hidden] -> f32[..., hidden]."""
        recurrent = state @ self.state_kernel + _as_row(self.bias[1], state.ndim)
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


def scaled_with_coordinates(observation: jax.Array) -> jax.Array:
    """u8[M, 12, 12, N] to f32[M, 12, 12, N + 3], all in [-1, 1].

    The channels after the N features are column, row and their Euclidean norm, each
    divided by its maximum and rescaled.
    """
    features = observation.astype(jnp.float32) / 127.5 - 1
    row, column = np.indices((BOARD_SIZE, BOARD_SIZE)) / (BOARD_SIZE - 1)
    radius = np.hypot(row, column)
    coordinates = 2 * np.stack([column, row, radius / radius.max()], axis=-1) - 1
    coordinates = jnp.asarray(coordinates, jnp.float32)
    shape = (*observation.shape[:-1], coordinates.shape[-1])
    return jnp.concatenate([features, jnp.broadcast_to(coordinates, shape)], axis=-1)


def patches(x: jax.Array, size: int) -> jax.Array:
    """The neighbourhood of every cell: f32[M, H, W, C] to f32[M, H, W, size * size * C].

    Row by row, zeros beyond the edge; an even size reaches further down and right.
    """
    before = (size - 1) // 2
    height, width = x.shape[1:3]
    padding = (before, size - 1 - before)
    x = jnp.pad(x, ((0, 0), padding, padding, (0, 0)))
    shifts = [x[:, i : i + height, j : j + width] for i in range(size) for j in range(size)]
    return jnp.concatenate(shifts, axis=-1)


def max_pool(x: jax.Array) -> jax.Array:
    """The maximum over 2x2 blocks: f32[M, H, W, C] to f32[M, H / 2, W / 2, C]."""
    count, height, width, channels = x.shape
    return jnp.max(x.reshape(count, height // 2, 2, width // 2, 2, channels), axis=(2, 4))


def _as_row(vector: jax.Array, ndim: int) -> jax.Array:
    """f32[1, ..., 1, C], to add f32[C] along the last axis."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))
