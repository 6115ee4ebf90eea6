"""Models of Stable-Baselines3 are scored on the observations that they were trained on."""

import numpy as np
import pytest

import trap_tube_jax as tt

sb3 = pytest.importorskip("stable_baselines3")
vec_env = pytest.importorskip("stable_baselines3.common.vec_env")

from trap_tube_jax.adapters.to_gymnasium import TrapTubeEnv

pytestmark = [pytest.mark.interop, pytest.mark.filterwarnings("default")]


def test_a_model_behind_vecnormalize_sees_normalised_observations(tmp_path, monkeypatch):
    env = vec_env.VecNormalize(vec_env.DummyVecEnv([lambda: TrapTubeEnv("base", max_steps=4)]))
    env.reset()
    for _ in range(6):
        env.step([[0, 0]])
    model = sb3.PPO("MlpPolicy", env, device="cpu")
    seen = []

    def record(observation, state=None, episode_start=None, deterministic=False):
        seen.append(observation)
        return np.array([0, 0]), None

    monkeypatch.setattr(model, "predict", record)
    tt.score_gymnasium(model, ["base"])
    first = np.asarray(tt.observe(tt.base_state()))
    np.testing.assert_allclose(seen[0], env.normalize_obs(first))
    assert not np.array_equal(seen[0], first)

    model.save(tmp_path / "model.zip")
    loaded = sb3.PPO.load(tmp_path / "model.zip", device="cpu")
    with pytest.raises(ValueError, match=r"acts on float32.*model\.set_env"):
        tt.score_gymnasium(loaded, ["base"])
    loaded.set_env(env)
    assert tt.score_gymnasium(loaded, ["base"])["base"].tasks == 1
