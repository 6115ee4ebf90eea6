"""Advantages and value targets from the rewards of episodes.

Two rules join the task's reward and the curiosity's: `combined_advantages` adds the rewards, `separate_advantages` the
advantages.

Source: Schulman et al. (2016); Burda et al. (2019b), "Combining intrinsic and extrinsic returns";
agents/agent.md, "PPO".
"""

import jax
import jax.numpy as jnp
import optax

from agents.acting.episodes import Episodes
from agents.config import Config
from agents.ppo import returns

# Deviation to which the curiosity's returns are scaled: about that of the task's returns, which lie
# in [0, 1], so that one weight of the value's error suits both.
RETURN_DEVIATION = 0.3

# Added to the variance of advantages, so that a stream that hardly pays is not blown up.
VARIANCE_FLOOR = 4e-4

RewardMoments = tuple[returns.Moments, returns.Moments]


def intrinsic_scale(config: Config) -> optax.Schedule:
    """The weight of the intrinsic reward, by iterations: constant, or falling geometrically."""
    start, end = config.intrinsic_coef_init, config.intrinsic_coef
    falling = round(config.intrinsic_anneal_fraction * config.iterations)
    if not start or not falling:
        return optax.constant_schedule(end)
    return optax.exponential_decay(start, falling, end / start, end_value=end)


def combined_advantages(
    config: Config,
    episodes: Episodes,
    novelty: jax.Array,
    scale: jax.typing.ArrayLike,
    value: jax.Array,
    moments: RewardMoments,
) -> tuple[jax.Array, jax.Array, RewardMoments]:
    """Advantages of the sum of both rewards, each over its deviation.

    Args:
      config: the settings.
      episodes: the episodes.
      novelty: f32[T, B], the intrinsic reward, 0 after an episode's end.
      scale: weight of the intrinsic reward.
      value: f32[T + 1, B, 1], of every observation.
      moments: of extrinsic and intrinsic reward so far.

    Returns:
      Advantages f32[T, B], the values' targets f32[T, B, 1], and the new moments.
    """
    extrinsic = moments[0].update(episodes.reward, episodes.mask, config.reward_ema_decay)
    intrinsic = moments[1].update(novelty, episodes.mask, config.reward_ema_decay)
    reward = episodes.reward / extrinsic.deviation
    reward = reward + scale * novelty / intrinsic.deviation
    advantage, target = advantages_and_targets(config, reward, episodes, value[..., 0])
    return advantage, target[..., None], (extrinsic, intrinsic)


def separate_advantages(
    config: Config,
    episodes: Episodes,
    novelty: jax.Array,
    scale: jax.typing.ArrayLike,
    value: jax.Array,
    moments: RewardMoments,
) -> tuple[jax.Array, jax.Array, RewardMoments]:
    """The sum of the advantages of both rewards, normalised apart.

    If the rewards were added, the louder one would decide: once easy tasks pay, what the agent
    still has to find out is lost in their variance (Burda et al., 2019b).

    The task's reward, at most 1 an episode, is taken as it is; the curiosity's is scaled so that
    its returns deviate by `RETURN_DEVIATION`.

    Arguments and results are those of `combined_advantages`, but for two streams, the task's and the
    curiosity's: values f32[T + 1, B, 2], their targets f32[T, B, 2], and the second moments are
    those of the intrinsic returns. Without a curiosity there is one stream, the task's.
    """
    gamma, lambda_ = jnp.float32(config.discount), jnp.float32(config.gae_lambda)
    mask = episodes.mask
    task, task_target = advantages_and_targets(config, episodes.reward, episodes, value[..., 0])
    if config.num_value_heads == 1:
        return task, task_target[..., None], moments
    intrinsic = moments[1].update(
        returns.discounted_returns(novelty, gamma), mask, config.reward_ema_decay
    )
    own = continuing_value(value[..., 1], mask)
    discount = jnp.full_like(novelty, gamma)
    reward = RETURN_DEVIATION * novelty / intrinsic.deviation
    curiosity = returns.generalized_advantages(reward, discount, own, mask, lambda_)
    target = jnp.stack([task_target, curiosity + own[:-1]], axis=-1)
    advantage = joint_advantage(task, curiosity, scale, mask)
    return advantage, target, (moments[0], intrinsic)


def advantages_and_targets(
    config: Config, reward: jax.Array, episodes: Episodes, value: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Advantages and the values' targets, f32[T, B] each, by the rule of `config.bootstrap`.

    `value`: gamma is 0 where a step terminates, the value of the last observation follows a
    truncated episode, and the target is A_t + v_t. `baseline`: gamma is the same everywhere, the
    last step's own value follows it, and the target is the discounted sum of rewards.

    Args:
      config: the settings.
      reward: f32[T, B], what the policy is to maximise.
      episodes: the episodes.
      value: f32[T + 1, B], of every observation.
    """
    gamma, lambda_ = jnp.float32(config.discount), jnp.float32(config.gae_lambda)
    if config.bootstrap == "value":
        discount = gamma * episodes.discount
        advantage = returns.generalized_advantages(reward, discount, value, episodes.mask, lambda_)
        return advantage, advantage + value[:-1]
    value = jnp.concatenate([value[:-1], value[-2:-1]])
    discount = jnp.full_like(reward, gamma)
    advantage = returns.generalized_advantages(reward, discount, value, episodes.mask, lambda_)
    return advantage, returns.discounted_returns(reward, gamma)


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
    task: jax.Array, curiosity: jax.Array, scale: jax.typing.ArrayLike, mask: jax.Array
) -> jax.Array:
    """Both advantages f32[T, B], normalised apart; the task's plus `scale` times the other."""
    task = returns.normalize(task, mask, VARIANCE_FLOOR)
    return task + scale * returns.normalize(curiosity, mask, VARIANCE_FLOOR)
