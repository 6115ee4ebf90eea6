"""The built-in rewards by hand, their losses and encoders, and that all can be copied."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import make_learner
from agents.acting.episodes import Episodes
from agents.curiosity import Curiosity, Experience
from agents.networks import make_encoder
from agents.registry import curiosities
from helpers.small_runs import small_config
from helpers.trees import COPIES

BOARD = jnp.zeros((1, 12, 12, 3), jnp.uint8)


def make(name: str, **settings: Any) -> Any:
    config = small_config(env_id="sy", curiosity=name, **settings)
    return curiosities.factory(name)(config, tt.make("sy"))


def reward_of(name: str, features: Any, column: Any) -> np.ndarray:
    """Computes rewards [B, T] from features [B, T + 1, F] and the columns of the agent."""
    nothing: Any = None  # for arrays that these rewards do not read
    column = jnp.array(column, jnp.uint8)
    cells = jnp.zeros((*column.shape, 3, 2), jnp.uint8).at[:, :, 0, 1].set(column)
    layout = jax.tree.map(lambda x: jnp.stack([x] * len(column)), tt.base_state())
    episodes = Episodes(layout, cells, *[nothing] * 4)
    experience = Experience(episodes, jnp.array(features, jnp.float32), *[nothing] * 3)
    return np.asarray(make(name).reward({}, (), experience)[0])


BY_HAND = {
    # The squared error at the next observation.
    "rnd": ([[[3, 4], [1, 0], [6, 8]]], [[0, 1, 2]], [[1, 100]]),
    # Errors of norms 5, 1, 10, 10 and 2, 4, 1, 9; the last observation of both has been seen.
    "noveld": (
        [[[3, 4], [1, 0], [6, 8], [6, 8]], [[2, 0], [0, 4], [1, 0], [0, 9]]],
        [[0, 1, 2, 2], [5, 6, 7, 5]],
        [[0, 10 - 0.5, 0], [4 - 1, 0, 0]],
    ),
}


@pytest.mark.parametrize("name", BY_HAND)
def test_rewards_equal_hand_computed_ones(name):
    features, column, expected = BY_HAND[name]
    np.testing.assert_allclose(reward_of(name, features, column), expected, rtol=1e-5)


@pytest.mark.parametrize("name", BY_HAND)
def test_an_episodes_reward_does_not_depend_on_other_episodes(name):
    features = np.random.default_rng(0).normal(size=(8, 6, 3))
    column = np.random.default_rng(1).integers(0, 4, size=(8, 6))
    whole = reward_of(name, features, column)
    np.testing.assert_array_equal(reward_of(name, features[4:], column[4:]), whole[4:])
    assert np.std(whole) > 0


def test_rnd_predicts_the_features_of_its_target():
    curiosity = make("rnd")
    board = jax.random.randint(jax.random.key(0), (3, 12, 12, 3), 0, 256).astype(jnp.uint8)
    params = jax.jit(curiosity.init)(jax.random.key(1), board)["params"]
    target: Any = make_encoder(small_config()).apply({"params": params["target"]}, board)
    constant = jax.tree.map(jnp.zeros_like, params["output"]) | {"bias": jnp.array([1.0, 2.0])}
    difference = curiosity.encode({"params": params | {"output": constant}}, board)
    np.testing.assert_allclose(difference, jnp.array([[1.0, 2.0]]) - target, rtol=1e-5)


def test_rnd_trains_the_predictor_alone():
    curiosity = make("rnd")
    board = jax.random.randint(jax.random.key(0), (3, 12, 12, 3), 0, 256).astype(jnp.uint8)
    params = jax.jit(curiosity.init)(jax.random.key(1), board)
    encode = jax.jit(curiosity.encode)

    nothing: Any = None

    def loss(params):
        features = encode(params, board)[None]
        experience = Experience(nothing, features, *[nothing] * 3)
        return jnp.sum(curiosity.losses(params, experience)["forward_loss"])

    features = encode(params, board)[1:]
    np.testing.assert_allclose(loss(params), jnp.sum(jnp.mean(features**2, axis=-1)), rtol=1e-5)
    gradient = jax.grad(loss)(params)["params"]
    assert not any(np.any(x) for x in jax.tree.leaves(gradient.pop("target")))
    assert all(np.any(x) for x in jax.tree.leaves(gradient["output"]))
    assert np.any(jax.tree.leaves(gradient["predictor"])[0])


@pytest.mark.parametrize("name", ["rnd", "noveld"])
def test_encoders_of_a_curiosity_are_of_the_policys_kind(name):
    encoder = make_encoder(small_config(encoder="objects"))
    wanted, found = (
        jax.tree.map(jnp.shape, nn.meta.unbox(jax.eval_shape(init, jax.random.key(0), BOARD)))
        for init in (encoder.init, make(name, encoder="objects").init)
    )
    for part in ("target", "predictor"):
        assert {"params": found["params"][part]} == wanted


@pytest.mark.parametrize("name", curiosities)
def test_copies_are_equal(name):
    curiosity = make(name)
    assert isinstance(curiosity, Curiosity)
    for copied in (copies(curiosity) for copies in COPIES.values()):
        assert type(copied) is type(curiosity)
        assert vars(copied) == vars(curiosity)


@pytest.fixture(params=[("jax_enable_x64", True), ("jax_numpy_dtype_promotion", "strict")])
def config_of_jax(request):
    name, value = request.param
    before = getattr(jax.config, name)
    jax.config.update(name, value)
    yield
    jax.config.update(name, before)


@pytest.mark.parametrize("name", ["icm", "noveld", "effects"])
def test_training_keeps_its_types_under_users_settings_of_jax(name, config_of_jax):
    """Nothing is computed, only traced."""
    learner = make_learner(small_config(curiosity=name, env_id="sy"))
    state = jax.eval_shape(learner.init, jax.random.key(0))
    after, metrics = jax.eval_shape(learner.iterate, state)
    assert after == state
    assert {metric.dtype for metric in metrics.values()} == {np.dtype(np.float32)}
