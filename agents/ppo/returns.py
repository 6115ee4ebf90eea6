"""Returns and advantages of one episode: functions of arrays, to vmap over episodes.

An episode has T steps; step t leads from observation t to observation t + 1. `mask` is 1 on the
steps that the episode took, with the last one, and 0 on padding.

Source: agents/agent.md, "PPO".
"""

import chex
import jax
import jax.numpy as jnp


def discounted_sum(x: jax.Array, discount: jax.Array) -> jax.Array:
    """Computes y_t = x_t + discount_t * y_{t+1}, y_T = 0, for `x` and `discount` f32[T]."""
    chex.assert_equal_shape([x, discount])

    def body(y: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        x_t, discount_t = inputs
        y = x_t + discount_t * y
        return y, y

    return jax.lax.scan(body, jnp.zeros_like(x[0]), (x, discount), reverse=True)[1]


def generalized_advantages(
    reward: jax.Array,
    discount: jax.Array,
    value: jax.Array,
    mask: jax.Array,
    lambda_: float | jax.Array,
) -> jax.Array:
    """Computes the generalised advantage estimates f32[T] of an episode (Schulman et al., 2016).

      delta_t = mask_t (r_t + discount_t v_{t+1} - v_t),
      A_t = delta_t + discount_t * lambda * A_{t+1},  A_T = 0.

    Args:
      reward: f32[T].
      discount: f32[T], gamma, or 0 where a step terminates.
      value: f32[T + 1], values of all observations.
      mask: f32[T].
      lambda_: scalar in [0, 1].
    """
    chex.assert_equal_shape([reward, discount, value[1:], mask])
    delta = mask * (reward + discount * value[1:] - value[:-1])
    return discounted_sum(delta, discount * lambda_)


def normalize(x: jax.Array, mask: jax.Array, epsilon: float = 1e-8) -> jax.Array:
    """Subtracts the masked mean of `x` f32[...] and divides by its masked standard deviation.

    Padding becomes 0. `epsilon` is added to the variance.
    """
    chex.assert_equal_shape([x, mask])
    variance = jnp.var(x, where=mask > 0)
    return mask * (x - jnp.mean(x, where=mask > 0)) / jnp.sqrt(variance + epsilon)
