"""Settings: presets, round trips, and what is refused."""

import dataclasses
import inspect
import json

import pytest

import trap_tube_jax as tt
from agents import Config, make_train
from agents.config import PRESETS
from agents.runs.folder import Run
from paths import ROOT


def test_paper_preset_is_the_specification():
    config = Config.preset("paper")
    expected = {
        "episodes_per_iteration": 1024,
        "max_steps": None,
        "epochs": 10,
        "minibatch_size": 128,
        "discount": 0.99,
        "gae_lambda": 0.95,
        "clip_eps": 0.2,
        "value_coef": 0.01,
        "entropy_coef": 1e-4,
        "learning_rate": 1e-3,
        "adam_epsilon": 1e-7,
        "max_gradient_norm": 1.0,
        "curiosity": "icm",
        "intrinsic_coef": 0.1,
        "curiosity_coef": 10.0,
        "reward_ema_decay": 0.9,
        "filters": (32, 64),
        "hidden": 64,
        "embedding": 8,
        "iterations": 250,
        "bootstrap": "baseline",
    }
    assert {name: getattr(config, name) for name in expected} == expected


def test_other_presets_are_those_of_the_recorded_results():
    """What is written about `fast` and `best` is about these settings."""
    records = ROOT / "benchmarks" / "results"
    for preset, file in (("fast", "fast_base.json"), ("best", "exp2_best.json")):
        stored = json.loads((records / file).read_text())["algorithms"][0]["config"]
        before = Run.from_dict({**Run(Config()).to_dict(), "config": stored}).config
        # The first record of `best` is older than its limit of steps, which changes one seed.
        same = dataclasses.replace(before, max_transitions=Config.preset(preset).max_transitions)
        assert same == Config.preset(preset, env_id=before.env_id)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_json(name):
    config = Config.preset(name)
    assert Config.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_every_setting_is_documented():
    text = inspect.getdoc(Config) or ""
    for field in dataclasses.fields(Config):
        assert f"\n  {field.name}: " in text, field


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"minibatch_size": 100}, ["minibatch", "100", "1024", "512"]),
        ({"minibatch_size": 0}, ["minibatch", "0", "1"]),
        ({"curiosity": "rdn"}, ["curiosity", "rdn", "icm-detached", "rnd", "none"]),
        ({"discount": 1.5}, ["discount", "1.5", "[0, 1]"]),
        ({"gae_lambda": -0.1}, ["gae_lambda", "-0.1"]),
        ({"episodes": 0}, ["episodes", "0"]),
        ({"episodes": 1.0}, ["episodes", "int", "1.0"]),
        ({"episodes": True}, ["episodes", "int", "True"]),
        ({"filters": (32,)}, ["filters", "tuple[int, int]", "(32,)"]),
        ({"filters": (0, 64)}, ["filters", "0"]),
        ({"replay_fractions": 0.5}, ["replayed", "tuple[float, ...]", "0.5"]),
        (
            {"replay_fractions": (0.6,), "episodes_per_iteration": 1, "minibatch_size": 1},
            ["1 episodes to new", "(0.6,)"],
        ),
        ({"adam_epsilon": 0.0}, ["adam_epsilon", "1e-12", "0.0"]),
        (
            {"intrinsic_coef_init": 0.01},
            ["intrinsic_coef_init", "at least intrinsic_coef=0.1", "0.01"],
        ),
        ({"learning_rate": "fast"}, ["learning_rate", "float", "fast"]),
        ({"align_to_food": 1}, ["align_to_food", "bool", "1"]),
        ({"bootstrap": "none"}, ["bootstrap", "none", "value, baseline"]),
        ({"curiosity": "none", "intrinsic_coef": 0.7}, ["intrinsic_scale", "0.7", "'none'"]),
        ({"curiosity": "counts", "curiosity_coef": 1.0}, ["curiosity_coef", "'counts'", "10.0"]),
        ({"failures": 3}, ["failures", "replay_fractions=()"]),
        ({"value_heads": "separate"}, ["rewards='apart'", "bootstrap='value'", "'baseline'"]),
        ({"intrinsic_coef_init": 1.0, "intrinsic_coef": 0.0}, ["intrinsic_coef_init > 0", "got 0"]),
        ({"num_features": 0}, ["num_features", "0"]),
        ({"max_steps": 0}, ["max_steps", "0"]),
        ({"max_steps": 5.0}, ["max_steps", "int | None", "5.0"]),
        ({"epsiodes": 3}, ["epsiodes", "did you mean 'episodes'", "minibatch"]),
    ],
)
def test_refusals_name_the_value_and_what_is_allowed(settings, words):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        Config.preset("paper", **settings)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_can_be_had_without_curiosity(name):
    assert Config.preset(name, curiosity="none").curiosity == "none"


def test_unknown_preset_lists_the_known():
    with pytest.raises(ValueError, match=r"quick.*paper.*fast"):
        Config.preset("quick")


def test_the_sets_own_limit_holds_unless_the_settings_give_one(own_task_sets):
    tt.register("Short-v0", (), max_steps=30)
    config = Config(env_id="Short-v0")
    assert make_train(config).env.max_steps == config.step_limit("Short-v0") == 30
    assert config.step_limit("p") == 50
    longer = Config(env_id="Short-v0", max_steps=60)
    assert make_train(longer).env.max_steps == longer.step_limit("p") == 60
    # A run of an earlier version has the limit of its set among its settings.
    Run(config).check_continues(Run(Config(env_id="Short-v0", max_steps=30)))
    with pytest.raises(ValueError, match="the run has max_steps=60, not 30"):
        Run(config).check_continues(Run(longer))


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_trains_in_an_environment_of_ones_own(name):
    own = tt.make("sy", max_steps=9)
    assert make_train(Config.preset(name), own).env is own


def test_environment_that_contradicts_the_config_is_refused():
    with pytest.raises(ValueError, match="max_steps is 9, the config's 50"):
        make_train(Config(max_steps=50), tt.make("p", max_steps=9))
