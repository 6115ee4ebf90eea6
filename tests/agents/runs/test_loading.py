"""Policies of runs, files and shipped agents are loaded by name, or refused with the known ones."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

import agents
import trap_tube_jax as tt
from agents import pretrained
from agents.arrays import to_arrays
from agents.config import Config
from agents.runs import checkpoint
from agents.runs.folder import RunFolder
from agents.runs.loading import read_policy, save
from agents.runs.run import Run
from helpers.jax_settings import enable_x64
from helpers.refusal import assert_refused
from helpers.tiny_policy import CONFIG, random_params, random_policy
from helpers.trees import assert_same

POLICY = random_policy()
ARRAYS = to_arrays(POLICY.params)


@pytest.fixture(scope="module")
def run_path(tmp_path_factory) -> Path:
    """A run of seed 3 with one checkpoint."""
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "mine")
    folder.write_config(Run(CONFIG, seed=3))
    state = {"params": {**random_params(), "curiosity": np.ones(2)}, "iteration": np.int32(6)}
    checkpoint.save(folder.checkpoints, 6, state, {})
    return folder.path


def test_runs_files_and_shipped_agents_are_loaded(run_path, tmp_path, monkeypatch):
    policy = agents.load(str(run_path), greedy=False)
    assert (policy.iteration, policy.greedy) == (6, False)
    assert_same(policy.params, random_params())
    agents.save(tmp_path / "x.safetensors", policy)
    assert_same(agents.load(tmp_path / "x.safetensors").params, policy.params)
    (tmp_path / "fast-base").mkdir()  # a folder that holds no run hides no shipped agent
    monkeypatch.chdir(tmp_path)
    assert agents.load("fast-base").config.env_id == "TrapTube-v0"


def test_a_run_that_selects_a_policy_is_loaded_as_this_policy(run_path, tmp_path):
    path = shutil.copytree(run_path, tmp_path / "copy")
    folder = RunFolder(path)
    save(folder.best, POLICY.replace(iteration=4))
    assert agents.load(path).iteration == 4
    assert agents.load(path, iteration=6).iteration == 6


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (None, "no checkpoint 5; allowed: 6"),
        ("none", "none is neither a run, a file nor a shipped agent; .* shipped agents: best"),
        ("fast-base", "iteration selects a checkpoint of a run, and fast-base is a file"),
    ],
)
def test_unknown_sources_and_iterations_are_refused(run_path, source, message):
    with pytest.raises(ValueError, match=message):
        agents.load(source or run_path, iteration=5)


def test_sources_that_are_nearly_right_are_answered_with_what_to_give(run_path):
    for source, words in (
        (run_path / "checkpoints" / "6.safetensors", "give the run, and iteration 6"),
        (run_path / "checkpoints", f"is in the run {run_path}; give the run"),
        (run_path / "config.json", f"is in the run {run_path}; give the run"),
        (run_path.parent, "give one of its runs: mine"),
        (run_path.parent / "mien", f"did you mean {run_path}?"),
    ):
        assert_refused([words], agents.load, source)


def test_a_leading_tilde_is_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    agents.save("~/x.safetensors", POLICY)
    assert (tmp_path / "x.safetensors").is_file()
    assert agents.load("~/x.safetensors").config == POLICY.config


def test_a_stored_policy_is_the_same(tmp_path):
    path = tmp_path / "mine.safetensors"
    curious = {**POLICY.params, "curiosity": {"of": np.ones(2)}}
    save(path, POLICY.replace(params=curious))
    loaded = read_policy(path)
    assert loaded.replace(params=None) == POLICY.replace(params=None)
    assert_same(loaded.params, POLICY.params)
    with enable_x64(True):
        assert_same(read_policy(path).params, POLICY.params)
    assert list(tmp_path.iterdir()) == [path]


def header(iteration: int | str = 1, **settings):
    values = {"config": {**CONFIG.to_dict(), **settings}, "iteration": iteration}
    return {"json": json.dumps(values)}


@pytest.mark.parametrize(
    ("stored", "changes", "message"),
    [
        *(({"json": text}, {}, "cannot be read: ") for text in ("{", "[]", '{"config": []}')),
        ({}, {}, "lacks 'json'"),
        ({"json": '{"iteration": 1}'}, {}, "lacks 'config'"),
        ({"json": json.dumps({"config": CONFIG.to_dict()})}, {}, "lacks 'iteration'"),
        (header(clip=0.2), {}, "unknown setting 'clip'"),
        (header(hidden=5), {}, r"core/params/bias is float32\[2, 12\], not float32\[2, 15\]"),
        (header(encoder="own"), {}, "unknown encoder 'own'.*--import MODULE"),
        (header(), {"heads/params/more": np.ones(1)}, "heads/params/more is not expected"),
        (header(), {"heads/params/value/bias": np.full(1, np.nan, np.float32)}, "is not finite"),
        (header(), {"heads/params/value/bias": None}, "heads/params/value/bias is missing"),
    ],
)
def test_files_of_other_content_are_refused(stored, changes, message, tmp_path):
    path = tmp_path / "mine.safetensors"
    arrays = {name: array for name, array in {**ARRAYS, **changes}.items() if array is not None}
    path.write_bytes(safetensors.numpy.save(arrays, stored))
    with pytest.raises(ValueError, match=message) as error:
        read_policy(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


PRESETS_OF = {
    "fast-base": ("fast", {}),
    "icm-base": ("paper", {"stop_when_solved": 1.0}),
    "best-pstsy": ("best", {}),
    "colors-finetuned": (
        "best",
        {
            "object_colors": True,
            "replay_fractions": (0.0625, 0.125, 0.25),
            "max_steps": 35,
            "discount": 0.95,
            "iterations": 400,
            "max_transitions": 4_000_000,
            "learning_rate": 3e-4,
            "lr_decay_fraction": 0.6,
            "intrinsic_coef_init": 0.0,
        },
    ),
    "colors-p+psy+pstsy": (
        "best",
        {
            "object_colors": True,
            "max_steps": 40,
            "replay_fractions": (0.0625, 0.125, 0.5),
        },
    ),
}


@pytest.mark.parametrize("name", list(pretrained.FILES))
def test_shipped_agents_have_the_presets_of_today_and_solve_their_tasks(name):
    policy = agents.load(name)
    (preset, changes) = PRESETS_OF[name]
    train_set = tt.task_set(policy.config.env_id)
    assert policy.config == Config.preset(preset, **changes, env_id=train_set.id)
    assert tt.score(policy, [train_set.short], tasks=32)[train_set.short].percent > 85
