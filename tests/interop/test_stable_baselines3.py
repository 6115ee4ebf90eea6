"""Stable-Baselines3's PPO on the Gymnasium adapter."""

import pytest

import trap_tube_jax as tt

stable_baselines3 = pytest.importorskip("stable_baselines3")
evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
monitor = pytest.importorskip("stable_baselines3.common.monitor")
torch = pytest.importorskip("torch")

from trap_tube_jax.adapters.to_gymnasium import TrapTubeEnv

pytestmark = [pytest.mark.interop, pytest.mark.filterwarnings("default")]


def test_ppo_learns_the_easy_task(easy_env, own_task_sets):
    torch.set_num_threads(1)  # its threads and JAX's would wait for each other
    env = monitor.Monitor(TrapTubeEnv(easy_env))
    model = stable_baselines3.PPO(
        "MlpPolicy", env, n_steps=256, batch_size=64, learning_rate=1e-3, seed=0, device="cpu"
    )
    before, _ = evaluation.evaluate_policy(model, env, n_eval_episodes=20, deterministic=False)
    model.learn(3_000)
    after, _ = evaluation.evaluate_policy(model, env, n_eval_episodes=20)
    assert before < 0.6
    assert after == 1.0
    tt.register("Easy-v0", (), base=easy_env.base, max_steps=easy_env.max_steps)
    assert tt.score_gymnasium(model, ["Easy-v0"], 1)["Easy-v0"].solved == 1
