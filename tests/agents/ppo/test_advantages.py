"""Advantages of two streams of rewards, normalised apart."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents import Config, make_learner
from agents.acting.episodes import Episodes
from agents.ppo import advantages
from helpers.trees import assert_same


def test_the_intrinsic_weight_decays_geometrically():
    config = Config(
        intrinsic_coef_init=8.0, intrinsic_coef=0.5, intrinsic_anneal_fraction=0.4, iterations=10
    )
    weight = advantages.intrinsic_coef_schedule(config)
    found = np.array([weight(iteration) for iteration in range(6)])
    np.testing.assert_allclose(found, [8, 4, 2, 1, 0.5, 0.5], rtol=1e-6)
    constant = advantages.intrinsic_coef_schedule(Config(intrinsic_coef=0.7))
    assert [constant(iteration) for iteration in (0, 9)] == [0.7, 0.7]
    # 0.29 * 100 is 28.999... in floating point.
    weight = advantages.intrinsic_coef_schedule(
        dataclasses.replace(config, intrinsic_anneal_fraction=0.29, iterations=100)
    )
    found = np.array([weight(28), weight(29)])
    np.testing.assert_allclose(found, [0.5 * 16 ** (1 / 29), 0.5], rtol=1e-5)


def plain_advantages(reward, discount, value, mask, lambda_):
    """Generalised advantages, step by step."""
    found = np.zeros_like(reward)
    following = 0.0
    for t in reversed(range(reward.shape[1])):
        delta = mask[:, t] * (reward[:, t] + discount[:, t] * value[:, t + 1] - value[:, t])
        found[:, t] = following = delta + discount[:, t] * lambda_ * following
    return found


def normal(x, mask):
    """As agents/agent.md has it, with the floor of the variance."""
    x = x - x[mask > 0].mean()
    return mask * x / np.sqrt(np.mean(x[mask > 0] ** 2) + 4e-4)


def test_separate_heads_estimate_the_advantages_of_both_rewards():
    """Of two episodes one is solved at its third step; the old moments have a variance of 4."""
    config = Config.preset("best")
    gamma = config.discount
    lambda_ = config.gae_lambda
    rate = config.reward_ema_decay
    rng = np.random.default_rng(0)
    value = rng.normal(size=(2, 6, 2))
    novelty = rng.random((2, 5))
    mask = np.ones((2, 5))
    reward = np.zeros((2, 5))
    going_on = np.ones((2, 5))
    mask[0, 3:] = 0
    reward[0, 2] = 1
    going_on[0, 2:] = 0
    novelty *= mask

    task = plain_advantages(reward, gamma * going_on, value[..., 0], mask, lambda_)
    returns_to_come = np.zeros((2, 6))
    for t in reversed(range(5)):
        returns_to_come[:, t] = novelty[:, t] + gamma * returns_to_come[:, t + 1]
    variance = rate * 4 + (1 - rate) * returns_to_come[:, :-1][mask > 0].var()
    bootstrapped = value[..., 1].copy()
    bootstrapped[0, 3:] = bootstrapped[:, 5] = bootstrapped[:, 0].mean()
    paid = 0.3 * novelty / np.sqrt(variance)
    discount = np.full((2, 5), gamma)
    curiosity = plain_advantages(paid, discount, bootstrapped, mask, lambda_)

    arrays = (jnp.array(x, jnp.float32) for x in (reward, going_on, mask))
    zero = jnp.zeros(())
    episodes = Episodes(tt.base_state(), zero, zero, *arrays)  # pyright: ignore
    old = jnp.full(2, 4.0)
    intrinsic_reward = jnp.float32(novelty)
    moments = advantages.update_variance(config, old, jnp.int32(3), episodes, intrinsic_reward)
    advantage, target = advantages.estimate(
        config, episodes, intrinsic_reward, 0.7, jnp.float32(value), moments
    )
    for found, expected in (
        (advantage, normal(task, mask) + 0.7 * normal(curiosity, mask)),
        (target[..., 0], task + value[:, :-1, 0]),
        (target[..., 1], curiosity + bootstrapped[:, :-1]),
        (moments, [rate * 4 + (1 - rate) * reward[mask > 0].var(), variance]),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_without_curiosity_separate_heads_are_one():
    config = Config.preset("best", hidden=4, filters=(4, 4), curiosity="none")
    params = jax.eval_shape(make_learner(config).init, jax.random.key(0)).params
    assert params["heads"]["params"]["value"]["kernel"].shape == (4, 1)
    value = jax.random.normal(jax.random.key(2), (8, 7, 1))
    ones = jnp.ones((8, 6))
    episodes = Episodes(tt.base_state(), *[ones] * 5)
    found = advantages.estimate(config, episodes, jnp.zeros((8, 6)), 3.0, value, jnp.zeros(2))
    expected = advantages.advantages_and_targets(config, ones, episodes, value[..., 0])
    assert_same((found[0], found[1][..., 0]), expected)


def test_rewards_that_do_not_vary_are_added_as_they_are():
    """As the extrinsic reward while nothing is solved."""
    config = Config()
    ones = jnp.ones((2, 3))
    nothing: Any = None
    episodes = Episodes(nothing, nothing, nothing, 0 * ones, ones, ones)
    value = jnp.zeros((2, 4, 1))
    found = advantages.estimate(config, episodes, ones, 0.5, value, jnp.zeros(2))
    expected = advantages.advantages_and_targets(config, 0.5 * ones, episodes, value[..., 0])
    assert_same((found[0], found[1][..., 0]), expected)
