"""Policies of runs, files and shipped agents are loaded by name, or refused with the known ones."""

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import agents
from agents.runs import checkpoint
from agents.runs.folder import Run, RunFolder
from easy import assert_same
from tiny_policy import CONFIG, random_params

SEEDS = (3, 4)


@pytest.fixture(scope="module")
def run_path(tmp_path_factory) -> Path:
    """A run of two seeds with one checkpoint."""
    path = tmp_path_factory.mktemp("runs") / "mine"
    folder = RunFolder(path)
    folder.note(Run(CONFIG, seed=SEEDS[0], seeds=2))
    params = [random_params(seed=seed) for seed in SEEDS]
    both = jax.tree.map(lambda *x: jnp.stack(x), *params)
    state = {"params": both, "iteration": jnp.full(2, 6)}
    checkpoint.save(folder.checkpoints, 6, state, {}, keep=1)
    return path


def test_runs_files_and_shipped_agents_are_loaded(run_path, tmp_path, monkeypatch):
    first, second = agents.load(str(run_path)), agents.load(run_path, seed=4, greedy=False)
    assert (first.name, first.iteration, first.greedy) == ("seed 3", 6, True)
    assert (second.name, second.iteration, second.greedy) == ("seed 4", 6, False)
    assert_same(second.params, random_params(seed=4))
    agents.save(tmp_path / "x.safetensors", first)
    assert_same(agents.load(tmp_path / "x.safetensors").params, first.params)
    (tmp_path / "fast-base").mkdir()  # a folder that holds no run hides no shipped agent
    monkeypatch.chdir(tmp_path)
    assert agents.load("fast-base").config.env_id == "TrapTube-v0"


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        (None, {"seed": 5}, "mine has no seed 5; it holds seed 3, seed 4"),
        (None, {"iteration": 5}, "no checkpoint 5; allowed: 6"),
        ("none", {}, "none is neither a run, a file nor a shipped agent; .* shipped agents: best"),
        ("fast-base", {"iteration": 5}, "iteration is for runs, which fast-base is not"),
        ("fast-base", {"seed": 0}, "fast-base has no seed 0; it holds fast-base"),
    ],
)
def test_unknown_sources_seeds_and_iterations_are_refused(run_path, source, options, message):
    with pytest.raises(ValueError, match=message):
        agents.load(source or run_path, **options)
