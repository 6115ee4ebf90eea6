"""Advantages and value targets from extrinsic and intrinsic rewards.

`Config.value_heads` chooses one of two rules. `shared` adds the rewards, each divided by its
standard deviation, and estimates the advantages of the sum:

  r_t = r^ext_t / std(r^ext) + intrinsic_coef * r^int_t / std(r^int).

`separate` estimates the advantages of each reward, normalises them and adds them. In a sum of
rewards the one of higher variance dominates: once easy tasks pay, the intrinsic reward vanishes in
their variance (Burda et al., 2019). The extrinsic reward, at most 1 per episode, is not scaled.
The intrinsic reward is scaled so that its returns have the standard deviation
`INTRINSIC_RETURN_STD`. Intrinsic returns are non-episodic: the next episode follows an episode's
end and is worth the mean of v_0. So finishing a task early forgoes no novelty.

Source: Schulman et al. (2016); Burda et al. (2019), "Combining intrinsic and extrinsic returns";
agents/agent.md, "PPO".
"""

import jax
import jax.numpy as jnp
import optax

from agents.acting.episodes import Episodes
from agents.config import Config
from agents.ppo import returns

# Standard deviation to which intrinsic returns are scaled: about the extrinsic returns',
# which are in [0, 1], so that one weight of the value error suits both.
INTRINSIC_RETURN_STD = 0.3

# Added to the variance of advantages, so that a nearly constant reward has small ones.
ADVANTAGE_EPSILON = 4e-4


def intrinsic_coef_schedule(config: Config) -> optax.Schedule:
    """Returns the intrinsic reward's weight by iteration: constant, or decaying geometrically."""
    start = config.intrinsic_coef_init
    end = config.intrinsic_coef
    steps = round(config.intrinsic_anneal_fraction * config.iterations)
    if not start or not steps:
        return optax.constant_schedule(end)
    return optax.exponential_decay(start, steps, end / start, end_value=end)


def update_variance(
    config: Config,
    variance: jax.Array,
    iteration: jax.Array,
    episodes: Episodes,
    intrinsic_reward: jax.Array,
) -> jax.Array:
    """Moves the variances f32[2] of both rewards towards the variances in B episodes.

    `intrinsic_reward` is f32[B, T]. Iteration 0 replaces the variances. With separate value heads,
    the second is the variance of the discounted intrinsic returns.
    """
    if config.value_heads == "separate":
        discount = jnp.full_like(intrinsic_reward, config.discount)
        intrinsic_reward = jax.vmap(returns.discounted_sum)(intrinsic_reward, discount)
    rewards = (episodes.reward, intrinsic_reward)
    new = jnp.stack([jnp.var(reward, where=episodes.mask > 0) for reward in rewards])
    keep = jnp.where(iteration == 0, jnp.float32(0), jnp.float32(config.reward_ema_decay))
    return keep * variance + (1 - keep) * new


def estimate(
    config: Config,
    episodes: Episodes,
    intrinsic_reward: jax.Array,
    intrinsic_coef: jax.typing.ArrayLike,
    value: jax.Array,
    variance: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Estimates the advantages of both rewards together.

    Args:
      config: settings.
      episodes: B episodes of T steps.
      intrinsic_reward: f32[B, T], 0 after an episode's end.
      intrinsic_coef: weight of the intrinsic reward.
      value: f32[B, T + 1, V], values of all observations. With separate value heads, the first head
        values the extrinsic reward and the second the intrinsic reward; V = 1 without a curiosity.
      variance: f32[2], as returned by `update_variance`; the deviation 0 counts as 1.

    Returns:
      Advantages f32[B, T] and value targets f32[B, T, V].
    """
    extrinsic_std, intrinsic_std = jnp.where(variance > 0, jnp.sqrt(variance), 1.0)
    novelty = intrinsic_reward / intrinsic_std
    reward = episodes.reward
    if config.value_heads == "shared":
        reward = reward / extrinsic_std + intrinsic_coef * novelty
    advantage, target = advantages_and_targets(config, reward, episodes, value[..., 0])
    if config.num_value_heads == 1:
        return advantage, target[..., None]
    novelty_advantage, novelty_target = non_episodic(config, novelty, episodes, value[..., 1])
    advantage = returns.normalize(advantage, episodes.mask, ADVANTAGE_EPSILON)
    novelty_advantage = returns.normalize(novelty_advantage, episodes.mask, ADVANTAGE_EPSILON)
    targets = jnp.stack([target, novelty_target], axis=-1)
    return advantage + intrinsic_coef * novelty_advantage, targets


def non_episodic(
    config: Config, novelty: jax.Array, episodes: Episodes, value: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Estimates advantages and targets, f32[B, T] each, of an intrinsic reward of deviation 1.

    The next episode follows an episode's end and is worth the mean of v_0.

    Args:
      config: settings.
      novelty: f32[B, T], divided by the standard deviation of its returns.
      episodes: B episodes of T steps.
      value: f32[B, T + 1], values of all observations.
    """
    continues = jnp.pad(episodes.mask, ((0, 0), (0, 1))) > 0
    value = jnp.where(continues, value, jnp.mean(value[:, 0]))
    discount = jnp.full_like(novelty, config.discount)
    reward = INTRINSIC_RETURN_STD * novelty
    advantage = _generalized_advantages(reward, discount, value, episodes.mask, config.gae_lambda)
    return advantage, advantage + value[:, :-1]


def advantages_and_targets(
    config: Config, reward: jax.Array, episodes: Episodes, value: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Estimates advantages and value targets, f32[B, T] each, by the rule of `config.bootstrap`.

    `value`: gamma is 0 where a step terminates, a truncated episode bootstraps from the value of
    its last observation, and the target is A_t + v_t. `baseline`: gamma is constant, step T
    bootstraps from its own value, even if it terminates, an earlier termination bootstraps from the
    final board, and the target is the discounted sum of rewards.

    Args:
      config: settings.
      reward: f32[B, T], the reward to maximise.
      episodes: B episodes of T steps.
      value: f32[B, T + 1], values of all observations.
    """
    mask = episodes.mask
    if config.bootstrap == "baseline":
        value = jnp.concatenate([value[:, :-1], value[:, -2:-1]], axis=1)
        discount = jnp.full_like(reward, config.discount)
        advantage = _generalized_advantages(reward, discount, value, mask, config.gae_lambda)
        return advantage, jax.vmap(returns.discounted_sum)(reward, discount)
    discount = config.discount * episodes.discount
    advantage = _generalized_advantages(reward, discount, value, mask, config.gae_lambda)
    return advantage, advantage + value[:, :-1]


_generalized_advantages = jax.vmap(returns.generalized_advantages, in_axes=(0, 0, 0, 0, None))
