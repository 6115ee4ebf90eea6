"""rejax's PPO on the five-value gymnax adapter, whatever gymnax is installed."""

import jax
import pytest

rejax = pytest.importorskip("rejax")

from trap_tube_jax.adapters import to_gymnax

pytestmark = [pytest.mark.interop, pytest.mark.filterwarnings("default")]


def test_ppo_learns_the_easy_task(easy_env):
    env, params = to_gymnax.make(easy_env)
    ppo = rejax.PPO.create(
        env=env,
        env_params=params,
        total_timesteps=8_192,
        eval_freq=4_096,
        num_envs=32,
        num_steps=32,
        num_minibatches=4,
        learning_rate=1e-3,
        normalize_observations=True,
    )
    _, (lengths, returns) = jax.jit(ppo.train)(jax.random.PRNGKey(0))
    success = returns.mean(axis=1)
    assert success[0] < 0.6
    assert success[-1] > 0.95
    assert lengths[0].mean() > lengths[-1].mean()
