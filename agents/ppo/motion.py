"""Auxiliary loss: predicts which things an action moves.

Reward and curiosity reveal little about which of several objects is the tool. The motion of every
step reveals more, and predicting this motion trains the GRU and the encoder. Two consecutive
observations show the motion, unless the tool has the colour of what it moves over. All other
targets of the loss are visible to the agent.

Source: this project; auxiliary losses of reinforcement learning, after Jaderberg et al. (2017).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from agents.networks.layers import dense, output_dense

UNITS = 128
THINGS = 3  # agent, tool and food
AXES = 2  # rows and columns


class MotionHead(nn.Module):
    """Predicts from the GRU's output and the action whether each thing changes row and column."""

    @nn.compact
    def __call__(self, hidden: jax.Array, action: jax.Array) -> jax.Array:
        """Maps f32[..., H] and an embedded action f32[..., E] to logits f32[..., 3, 2]."""
        x = nn.swish(dense(UNITS)(jnp.concatenate([hidden, action], axis=-1)))
        return output_dense(THINGS * AXES)(x).reshape(*x.shape[:-1], THINGS, AXES)


def motion_loss(logits: jax.Array, cells: jax.Array) -> jax.Array:
    """Returns the cross-entropy f32[B, T] of the motion of a step, summed over things and axes.

      loss_t = -sum log p(moved_t), moved_t = [cells_{t+1} != cells_t]

    Args:
      logits: f32[B, T, 3, 2].
      cells: integer[B, T + 1, 3, 2], (row, column) of agent, tool and food.
    """
    moved = (cells[:, 1:] != cells[:, :-1]).astype(jnp.float32)
    return jnp.sum(optax.sigmoid_binary_cross_entropy(logits, moved), axis=(-2, -1))
