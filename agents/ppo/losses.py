"""Terms of the loss: functions of arrays, one number per step.

Source: agents/agent.md, "PPO".
"""

import chex
import jax
import jax.numpy as jnp


def padded_mean(x: jax.Array, mask: jax.Array) -> jax.Array:
    """Sums `x` f32[...] where `mask` is 1, and divides by the number of all elements.

    As in the published baseline, steps after an episode's end count as zeros, so an episode that
    ends early weighs less.
    """
    chex.assert_equal_shape([x, mask])
    return jnp.mean(x * mask)


def clipped_surrogate(
    log_prob: jax.Array, old_log_prob: jax.Array, advantage: jax.Array, clip_eps: float
) -> jax.Array:
    """Computes PPO's clipped surrogate (Schulman et al., 2017, equation 7), negated to minimise.

      ratio = exp(log_prob - old_log_prob)
      loss = -min(ratio * A, clip(ratio, 1 - clip_eps, 1 + clip_eps) * A)

    Args:
      log_prob: f32[...], log-probabilities of the actions under the current parameters.
      old_log_prob: f32[...], the same under the parameters that acted.
      advantage: f32[...].
      clip_eps: half-width of the interval of ratios.
    """
    chex.assert_equal_shape([log_prob, old_log_prob, advantage])
    ratio = jnp.exp(log_prob - old_log_prob)
    clipped = jnp.clip(ratio, 1 - clip_eps, 1 + clip_eps)
    return -jnp.minimum(ratio * advantage, clipped * advantage)
