"""Settings: presets, round trips, and what is refused."""

import json
import math

import jax
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, make_learner
from agents.config import PRESETS
from helpers.refusal import assert_refused


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_the_same_after_json(name):
    config = Config.preset(name)
    assert Config.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_trains_in_a_custom_environment_without_curiosity_and_previous_inputs(name):
    env = tt.make("sy", max_steps=9)
    assert make_learner(Config.preset(name), env).env is env
    learner = make_learner(Config.preset(name, curiosity="none", previous_inputs=False), env)
    state = jax.eval_shape(learner.init, jax.random.key(0))
    after, _ = jax.eval_shape(learner.iterate, state)
    assert after == state


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"minibatch_size": 100}, ["minibatch_size must divide", "100", "1024", "512"]),
        ({"minibatch_size": 0}, ["minibatch_size must be an integer from 1 to 1,000,000, got 0"]),
        ({"curiosity": "rdn"}, ["curiosity", "rdn", "icm", "rnd", "none"]),
        ({"discount": 1.5}, ["discount", "1.5", "from 0 to 1"]),
        ({"recurrent": "no"}, ["recurrent must be True or False", "'no'"]),
        ({"env_id": None}, ["env_id must be a name", "None"]),
        ({"replay_fractions": 0.5}, ["replay_fractions must be a tuple of numbers", "0.5"]),
        ({"max_gradient_norm": 0.0}, ["max_gradient_norm", "from 1e-12", "0.0"]),
        ({"gae_lambda": -0.1}, ["gae_lambda", "-0.1"]),
        ({"episodes_per_iteration": 1.0}, ["episodes_per_iteration", "integer", "1.0"]),
        ({"episodes_per_iteration": True}, ["episodes_per_iteration", "integer", "True"]),
        ({"episodes_per_iteration": 10**9}, ["episodes_per_iteration", "1000000000"]),
        ({"max_transitions": 3 * 10**9}, ["from 1 to 2,147,483,647, got 3000000000"]),
        ({"filters": (32,)}, ["filters must be 2 numbers, each an integer", "(32,)"]),
        ({"filters": (0, 64)}, ["filters", "0"]),
        ({"replay_fractions": (0.6, 0.4)}, ["replay_fractions must leave", "(0.6, 0.4)"]),
        ({"adam_epsilon": 0.0}, ["adam_epsilon", "1e-12", "0.0"]),
        ({"learning_rate": "fast"}, ["learning_rate", "finite number", "fast"]),
        ({"value_coef": math.nan}, ["value_coef", "finite number", "nan"]),
        ({"bootstrap": "none"}, ["bootstrap", "none", "value, baseline"]),
        (
            {"value_heads": "separate"},
            ["value_heads='separate'", "bootstrap='value'", "'baseline'"],
        ),
        ({"object_colors": True}, ["object_colors needs encoder='objects', got 'paper'"]),
        ({"intrinsic_coef_init": 0.01}, ["intrinsic_coef_init", "at least intrinsic_coef", "0.01"]),
        ({"intrinsic_coef_init": 1.0, "intrinsic_coef": 0.0}, ["> 0", "intrinsic_coef=0.0"]),
        ({"epsiodes_per_iteration": 3}, ["did you mean 'episodes_per_iteration'", "epochs"]),
    ],
)
def test_refusals_name_the_value_and_what_is_allowed(settings, words):
    assert_refused(words, Config.preset, "paper", **settings)


def test_numpy_scalars_become_numbers_of_python():
    values = {"learning_rate": np.float64(1e-3), "hidden": np.int64(8), "filters": [np.int32(2), 4]}
    config = Config(**values)
    assert config == Config(learning_rate=1e-3, hidden=8, filters=(2, 4))
    assert json.loads(json.dumps(config.to_dict()))["hidden"] == 8


def test_the_limit_of_steps_allows_an_iteration():
    config = Config(env_id="Unknown-v0", max_transitions=51_199)  # a policy's, without its set
    words = ["takes up to 51,200 steps, or be None; got 51,199"]
    assert_refused(words, make_learner, config, tt.make("base"))


def test_unknown_preset_lists_the_known():
    assert_refused(["unknown preset 'quick'", "paper", "fast"], Config.preset, "quick")


def test_the_step_limit_of_the_task_set_holds_unless_the_settings_give_one(fresh_task_sets):
    tt.register("Short-v0", (), max_steps=30)
    config = Config(env_id="Short-v0")
    assert make_learner(config).env.max_steps == config.step_limit == 30
    longer = Config(env_id="Short-v0", max_steps=60)
    assert make_learner(longer).env.max_steps == longer.step_limit == 60
