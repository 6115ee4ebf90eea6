"""Two streams of rewards, the task's and the curiosity's, each with a value of its own.

Added up as rewards, the louder one decides: once easy tasks pay, what the agent still has to find
out is lost in their variance. So each stream has its own value, its advantages are normalised
apart, and only then added.

Source: Burda et al. (2019b), "Combining intrinsic and extrinsic returns".
"""

import jax
import jax.numpy as jnp

from agents.ppo import returns

# Added to the variance of advantages, so that a stream that hardly pays is not blown up.
VARIANCE_FLOOR = 4e-4


def continuing_value(value: jax.Array, mask: jax.Array) -> jax.Array:
    """Values of a stream that does not end with the episode.

    What follows an episode is the next one, which is worth what episodes are worth at their
    start: the mean of v_0. So finishing a task early does not cost the novelty that is left in it.

    Args:
      value: f32[T + 1, B].
      mask: f32[T, B], 1 on steps before the episode's end.

    Returns:
      f32[T + 1, B], the values, and the mean of v_0 from the episode's end on.
    """
    goes_on = jnp.concatenate([mask, jnp.zeros_like(mask[:1])])
    return jnp.where(goes_on > 0, value, jnp.mean(value[0]))


def joint_advantage(
    task: jax.Array, curiosity: jax.Array, scale: float, mask: jax.Array
) -> jax.Array:
    """Both advantages f32[T, B], normalised apart; the task's plus `scale` times the other."""
    task = returns.normalize(task, mask, VARIANCE_FLOOR)
    return task + scale * returns.normalize(curiosity, mask, VARIANCE_FLOOR)
