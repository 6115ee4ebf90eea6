"""Encoding each distinct observation once changes neither the loss nor its gradient."""

import jax
import numpy as np
import pytest

from agents import make_learner
from agents.acting.encodings import encode_episodes
from agents.ppo import learner
from small_runs import small_config


@pytest.mark.parametrize("curiosity", ["icm", "none", pytest.param("rnd", marks=pytest.mark.slow)])
def test_the_loss_and_its_gradient_are_those_of_the_plain_encoding(curiosity, monkeypatch):
    train = make_learner(small_config(env_id="psy", curiosity=curiosity))

    def plain_encoding(encode_rows, params, episodes, *, chunk):
        del encode_rows, chunk
        rows = episodes.observations()
        features = jax.vmap(lambda rows: train.agent.encode(params, rows))(rows)
        return features, jax.vmap(lambda rows: train.curiosity.encode(params["curiosity"], rows))(
            rows
        )

    @jax.jit
    def prepare(key):
        init_key, play_key, action_key = jax.random.split(key, 3)
        state = train.init(init_key)
        trajectory = train.play(state.params, jax.random.split(play_key, 8), action_key)
        reward, _ = train.intrinsic_reward(state, trajectory)
        return state.params, train.make_batch(state, trajectory, reward)[0]

    def loss_of(encoding):
        monkeypatch.setattr(learner, "encode_episodes", encoding)
        return jax.jit(jax.value_and_grad(lambda p, batch: train.loss(p, batch)[0]))

    params, batch = prepare(jax.random.key(4))
    plain = loss_of(plain_encoding)(params, batch)
    fast = loss_of(encode_episodes)(params, batch)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), fast, plain)
