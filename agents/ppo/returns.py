"""Returns, advantages and the variances that scale them: functions of arrays.

Episodes have T steps; step t leads from observation t to observation t + 1. `mask` is 1 on steps
before the episode's end, 0 after it.

Source: agents/agent.md, "PPO" and "Curiosity".
"""

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp


def discounted_returns(reward: jax.Array, discount: float | jax.Array) -> jax.Array:
    """Computes discounted sums of rewards to the end of the episode, without bootstrap.

      G_t = r_t + discount * G_{t+1},  G_T = 0.

    Args:
      reward: f32[T, ...], zero after the end.
      discount: scalar in [0, 1].
    """
    return _backward_sum(reward, jnp.full(len(reward), discount, reward.dtype))


def generalized_advantages(
    reward: jax.Array,
    discount: jax.Array,
    value: jax.Array,
    mask: jax.Array,
    lambda_: float | jax.Array,
) -> jax.Array:
    """Computes generalised advantage estimates of padded episodes (Schulman et al., 2016).

      delta_t = mask_t (r_t + discount_t v_{t+1} - v_t),
      A_t = delta_t + discount_t * lambda * A_{t+1},  A_T = 0.

    Args:
      reward: f32[T, ...].
      discount: f32[T, ...], gamma, or 0 where a step terminates.
      value: f32[T + 1, ...], values of all observations.
      mask: f32[T, ...].
      lambda_: scalar in [0, 1].
    """
    chex.assert_equal_shape([reward, discount, value[1:], mask])
    delta = mask * (reward + discount * value[1:] - value[:-1])
    return _backward_sum(delta, discount * lambda_)


def masked_moments(x: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes the mean and variance f32[] of `x` f32[...] where `mask` f32[...] is 1.

    Both are 0 if the mask is empty.
    """
    chex.assert_equal_shape([x, mask])
    count = jnp.maximum(jnp.sum(mask), 1.0)
    mean = jnp.sum(x * mask) / count
    return mean, jnp.sum(jnp.square(x - mean) * mask) / count


def normalize(x: jax.Array, mask: jax.Array, epsilon: float = 1e-8) -> jax.Array:
    """Subtracts the masked mean of `x` f32[...] and divides by its masked standard deviation."""
    mean, variance = masked_moments(x, mask)
    return mask * (x - mean) / jnp.sqrt(variance + epsilon)


class RunningVariance(NamedTuple):
    """Exponential moving average of the variance of batches.

    Attributes:
      variance: f32[].
      batches: i32[], batches seen; the first one replaces the zeros.
    """

    variance: jax.Array
    batches: jax.Array

    @staticmethod
    def zero() -> "RunningVariance":
        """Returns the variance before the first batch."""
        return RunningVariance(jnp.zeros((), jnp.float32), jnp.zeros((), jnp.int32))

    def update(self, x: jax.Array, mask: jax.Array, decay: float) -> "RunningVariance":
        """Moves by 1 - `decay` towards the variance of a batch f32[...] under its mask."""
        _, variance = masked_moments(x, mask)
        keep = jnp.where(self.batches == 0, jnp.float32(0), jnp.float32(decay))
        return RunningVariance(keep * self.variance + (1 - keep) * variance, self.batches + 1)

    @property
    def std(self) -> jax.Array:
        """Standard deviation f32[], 1 where it would be 0."""
        return jnp.where(self.variance > 0, jnp.sqrt(self.variance), 1.0)


def _backward_sum(x: jax.Array, decay: jax.Array) -> jax.Array:
    """Computes y_t = x_t + decay_t * y_{t+1}, y_T = 0; decay is f32[T], or f32[T, ...] as x."""

    def body(y: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        x_t, decay_t = inputs
        y = x_t + decay_t * y
        return y, y

    return jax.lax.scan(body, jnp.zeros_like(x[0]), (x, decay), reverse=True)[1]
