"""NovelD, RIDE and E3B: their rewards by hand, their losses, and that episodes are paid apart."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, curiosity, make_train, registry
from agents.acting.episodes import Episodes
from agents.arrays import from_arrays, to_arrays
from agents.curiosity import Experience
from agents.curiosity.e3b import elliptical_bonus
from agents.networks.layers import draw
from agents.ppo.learner import Learner
from agents.runs.checkpoint import digest

SETTINGS = Config(
    env_id="sy",
    max_steps=6,
    episodes_per_iteration=8,
    minibatch_size=4,
    epochs=1,
    filters=(2, 3),
    hidden=4,
    embedding=2,
    encode_chunk_size=4,
    eval_episodes=2,
    bootstrap="value",
).to_dict()


def learner_of(name: str) -> Learner:
    return make_train(Config.from_dict({**SETTINGS, "curiosity": name}))


def reward_of(name: str, features: Any, observation_id: Any) -> np.ndarray:
    """The rewards [T, B] by features [T + 1, B, F] alone."""
    features = jnp.array(features, jnp.float32)
    experience = Experience(None, jnp.array(observation_id), features)  # pyright: ignore
    train = learner_of(name)
    return np.asarray(train.curiosity.reward({}, (), experience)[0])


def test_rnd_pays_the_squared_error_at_the_next_observation():
    features = [[[3, 4]], [[1, 0]], [[6, 8]]]
    np.testing.assert_allclose(reward_of("rnd", features, [[0], [1], [2]]), [[1], [100]])


def test_rnd_trains_the_predictor_alone():
    curious: Any = learner_of("rnd").curiosity
    board = jax.random.randint(jax.random.key(0), (3, 12, 12, 3), 0, 256).astype(jnp.uint8)
    params = curious.init(jax.random.key(1), board)

    def loss(params):
        features = curious.encode(params, board)[:, None]
        experience = Experience(None, None, features)  # pyright: ignore
        return jnp.sum(curious.losses(params, experience)["forward_loss"])

    features = curious.encode(params, board)[1:]
    np.testing.assert_allclose(loss(params), jnp.sum(jnp.mean(features**2, axis=-1)), rtol=1e-5)
    gradient = jax.grad(loss)(params)["params"]
    assert not any(np.any(x) for x in jax.tree.leaves(gradient.pop("target")))
    assert all(np.any(x) for x in jax.tree.leaves(gradient["output"]))
    assert np.any(jax.tree.leaves(gradient["predictor"])[0])


def test_noveld_pays_rises_of_novelty_at_first_visits():
    # Norms 5, 1, 10, 10 and 2, 4, 1, 9.
    features = [[[3, 4], [2, 0]], [[1, 0], [0, 4]], [[6, 8], [1, 0]], [[6, 8], [0, 9]]]
    ids = [[0, 5], [1, 6], [2, 7], [2, 5]]
    expected = [[0, 4 - 1], [10 - 0.5, 0], [0, 0]]
    np.testing.assert_allclose(reward_of("noveld", features, ids), expected, rtol=1e-6)


def test_ride_pays_changes_over_the_root_of_visits():
    features = [[[0, 0]], [[3, 4]], [[0, 0]], [[0, 0]], [[6, 8]]]
    ids = [[0], [1], [0], [0], [1]]
    expected = [[5], [5 / 2**0.5], [0], [10 / 2**0.5]]
    np.testing.assert_allclose(reward_of("ride", features, ids), expected, rtol=1e-6)


def test_e3b_pays_what_is_unlike_the_episode():
    features = [[[1, 0]], [[1, 0]], [[0, 2]], [[1, 0]], [[1, 2]]]
    expected = [[1 / 1.1], [4 / 0.1], [1 / 2.1], [1 / 3.1 + 4 / 4.1]]
    np.testing.assert_allclose(reward_of("e3b", features, np.zeros((5, 1))), expected, rtol=1e-5)


def test_elliptical_bonus_is_that_of_the_inverse_matrix():
    features = np.random.default_rng(0).normal(size=(9, 3, 4))
    bonus = elliptical_bonus(jnp.array(features, jnp.float32))
    for episode in range(3):
        matrix = 0.1 * np.eye(4)
        for time in range(9):
            f = features[time, episode]
            expected = f @ np.linalg.inv(matrix) @ f
            np.testing.assert_allclose(bonus[time, episode], expected, rtol=1e-3)
            matrix += np.outer(f, f)


@pytest.mark.parametrize("name", ["rnd", "noveld", "ride", "e3b"])
def test_an_episode_is_paid_the_same_among_others_as_apart(name):
    """So devices that share the episodes pay as one does."""
    features = np.random.default_rng(0).normal(size=(6, 8, 3))
    ids = np.random.default_rng(1).integers(0, 4, size=(6, 8))
    whole = reward_of(name, features, ids)
    np.testing.assert_array_equal(reward_of(name, features[:, 4:], ids[:, 4:]), whole[:, 4:])
    assert np.std(whole) > 0


@pytest.mark.parametrize(("name", "shaped"), [("icm-detached", False), ("ride", True)])
def test_the_forward_loss_shapes_the_features_of_ride_alone(name, shaped):
    curious: Any = learner_of(name).curiosity
    action = jnp.zeros((2, 1, 2), jnp.int32)
    features = jax.random.normal(jax.random.key(0), (3, 1, 3))
    # The two models without their encoder, which would only take time.
    key, seen = jax.random.key(1), features[:-1]
    models = {
        "forward": curious._forward.init(key, seen, jnp.zeros((2, 1, 8))),
        "inverse": curious._inverse.init(key, seen, seen),
    }
    params = draw(key, models)
    episodes = Episodes(tt.base_state(), action, action, action, action, action)

    def loss(features, name):
        experience = Experience(episodes, jnp.zeros((3, 1)), features)
        return jnp.sum(curious.losses(params, experience)[name])

    assert bool(np.any(jax.grad(loss)(features, "forward_loss"))) == shaped
    assert np.any(jax.grad(loss)(features, "inverse_loss"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["noveld", "ride", "e3b"])
def test_training_resumes_to_the_same_bits(name):
    train = make_train(Config.from_dict({**SETTINGS, "curiosity": name}))
    start = train.init(jax.random.key(0))
    iterate = jax.jit(train.iterate)
    once, metrics = iterate(start)
    assert metrics["forward_loss" if name == "noveld" else "inverse_loss"] > 0
    stored = from_arrays(to_arrays(once), jax.eval_shape(lambda: once))
    assert digest(to_arrays(iterate(stored)[0])) == digest(to_arrays(iterate(once)[0]))
    assert digest(to_arrays(once)) != digest(to_arrays(start))


@pytest.mark.parametrize("name", ["icm-detached", "rnd", "noveld", "ride", "e3b"])
def test_encoders_of_a_curiosity_are_of_the_kind_of_the_policys(name):
    own = {"curiosity": name, "encoder": "objects"}
    train = make_train(Config.from_dict({**SETTINGS, **own}))
    params = jax.eval_shape(train.init_params, jax.random.key(0))
    policys = jax.tree.map(jnp.shape, params["encoder"]["params"])
    trained = params["curiosity"]
    if name in ("rnd", "noveld"):
        found = [trained["params"][part] for part in ("target", "predictor")]
    else:
        found = [trained["encoder"]["params"]]
    for encoder in found:
        assert jax.tree.map(jnp.shape, encoder) == policys


def test_every_name_makes_a_curiosity():
    names = registry.curiosities
    assert {"noveld", "ride", "e3b"} <= set(names)
    for name in names:
        assert isinstance(learner_of(name).curiosity, curiosity.Curiosity)
