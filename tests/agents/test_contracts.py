"""Registered curiosities and encoders: a breach of their contract is refused in one line."""

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from agents import Config, make_learner
from agents.curiosity import Curiosity
from agents.networks.encoder import Encoder
from agents.networks.layers import dense, init_module
from agents.parallel.devices import EpisodeAxis
from agents.registry import curiosities, encoders
from helpers.curiosities import Returning
from helpers.small_runs import SETTINGS

PLAIN = Config(**{**SETTINGS, "episodes_per_iteration": 2, "minibatch_size": 2}, curiosity="none")


@pytest.fixture
def with_curiosity(monkeypatch):
    """Builds a learner with a curiosity."""

    def build(curiosity, **arguments):
        monkeypatch.setattr(curiosities, "factory", lambda name: lambda config, env: curiosity)
        return make_learner(PLAIN, **arguments)

    return build


class Broken(Curiosity):
    """Has other methods."""

    def __init__(self, **methods):
        vars(self).update(methods)


@pytest.mark.parametrize(
    ("curiosity", "message"),
    [
        (Returning(reward=jnp.zeros(3, jnp.float32)), r"'none' .*\(3,\) != \(2, 6\)"),
        (Returning(reward=jnp.zeros((2, 6), jnp.int32)), "'none' .*int32 != float32"),
        (Returning(given=jnp.zeros(2, jnp.int32)), r"'none' .*\(2,\) != \(\)"),
        (Returning(losses=["policy_loss"]), "must end in '_loss' .* got policy_loss"),
        (Returning(losses=["mine"]), "'none' .* motion_loss; got mine"),
        (Returning(losses={"my_loss": jnp.ones(3)}), r"'none' .*\(3,\)"),
        (None, "NoneType is no agents.curiosity.Curiosity"),
        (Broken(init=lambda *_: {"n": jnp.int32(3)}), r"parameter \['n'\] is int32"),
        (Broken(init=lambda key, x: init_module(Normalised(), key, x)), "batch_stats"),
        (Broken(encode=lambda *_: None), "encode must return an array"),
        (Broken(encode=lambda *_: jnp.zeros((1, 4))), r"\(1, 4\)"),
        (Broken(encode=lambda params, x: jnp.zeros((len(x), 4), jnp.int32)), "int32"),
        (Broken(reward=lambda *_: None), "'none' breaks its contract"),
        (Broken(reward=lambda *_: (0.0, ())), r"\(\) != \(2, 6\)"),
        (Broken(losses=lambda *_: None), "losses are NoneType, not a dict"),
        (Broken(losses=lambda *_: {"my_loss": None}), "'none' breaks its contract"),
    ],
)
def test_whatever_a_curiosity_returns_is_refused_in_one_line(curiosity, message, with_curiosity):
    def train() -> None:
        made = with_curiosity(curiosity)
        jax.eval_shape(made.iterate, jax.eval_shape(made.init, jax.random.key(0)))

    with pytest.raises(ValueError, match=message) as error:
        train()
    assert "\n" not in str(error.value)
    assert "Chex" not in str(error.value)


def test_a_module_that_a_curiosity_initialises_by_itself_is_drawn(with_curiosity):
    custom = with_curiosity(Broken(init=lambda key, x: dense(4).init(key, x.reshape(1, -1))))
    params = custom.init(jax.random.key(0)).params["curiosity"]["params"]
    assert len(np.unique(params["kernel"])) > 1_000


class Applying(nn.Module):
    """Returns a function of the observations."""

    function: Callable[[jax.Array], jax.Array]

    def __call__(self, observation):
        return self.function(observation)


class Normalised(nn.Module):
    """Has statistics besides parameters."""

    @nn.compact
    def __call__(self, observation):
        flat = observation.reshape(len(observation), -1) / jnp.float32(255)
        return nn.BatchNorm(use_running_average=False)(flat)


class Integer(nn.Module):
    """Has a parameter that no gradient trains."""

    @nn.compact
    def __call__(self, observation):
        count = self.param("count", lambda key: jnp.int32(3))
        return observation.reshape(len(observation), -1) * jnp.float32(count)


class Around(nn.Module):
    """Has a part that others may have, too."""

    part: nn.Module

    @nn.compact
    def __call__(self, observation):
        return self.part(observation)


class Noisy(nn.Module):
    """Draws at random."""

    @nn.compact
    def __call__(self, observation):
        flat = observation.reshape(len(observation), -1) / jnp.float32(255)
        return nn.Dropout(0.5, deterministic=False)(flat)


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (Applying(jnp.float32), r"encoder 'mine' .*\(1, 12, 12, 3\)"),
        (Applying(lambda x: x.reshape(len(x), -1)), "encoder 'mine' .*uint8"),
        (Applying(lambda x: jnp.zeros((len(x), 0))), "encoder 'mine' .*greater than '0' on axis"),
        (Normalised(), "encoder 'mine' .*batch_stats"),
        (Integer(), "encoder 'mine' .*count.* is int32"),
        (Noisy(), "encoder 'mine' .*dropout"),
        (nnx.Linear(3, 4, rngs=nnx.Rngs(0)), "must be a flax.linen.Module, got Linear"),
        (None, "must be a flax.linen.Module, got NoneType"),
    ],
)
def test_an_encoder_that_breaks_its_contract_is_refused_in_one_line(module, message, monkeypatch):
    monkeypatch.setitem(encoders, "mine", lambda config: module)

    def train() -> None:
        made = make_learner(Config(encoder="mine"))
        jax.eval_shape(made.iterate, made.init(jax.random.key(0)))

    with pytest.raises(ValueError, match=message) as error:
        train()
    assert "\n" not in str(error.value)


def test_two_encoders_of_one_module_share_no_parameters(monkeypatch):
    """The predictor of `rnd` must not be its target."""
    shared = Encoder((2, 2))
    monkeypatch.setitem(encoders, "mine", lambda config: shared)
    config = Config(**{**SETTINGS, "encoder": "mine", "curiosity": "rnd"})
    params = make_learner(config).init(jax.random.key(0)).params["curiosity"]["params"]
    assert set(params) == {"target", "predictor", "hidden", "output"}
    target, predictor = (params[name]["conv1"]["kernel"] for name in ("target", "predictor"))
    assert not np.any(np.isclose(target, predictor))


def test_two_encoders_that_share_a_part_are_refused(monkeypatch):
    part = Encoder((2, 2))
    monkeypatch.setitem(encoders, "mine", lambda config: Around(part))
    learner = make_learner(Config(**{**SETTINGS, "encoder": "mine", "curiosity": "none"}))
    jax.eval_shape(learner.init, jax.random.key(0))  # one alone is allowed
    with pytest.raises(ValueError, match=r"encoder 'mine' .*share a module; build all"):
        make_learner(Config(**{**SETTINGS, "encoder": "mine", "curiosity": "rnd"}))


def test_devices_average_floats_only(with_curiosity):
    with pytest.raises(ValueError, match="'none' cannot train on several devices"):
        with_curiosity(Returning(), axis=EpisodeAxis(2))
