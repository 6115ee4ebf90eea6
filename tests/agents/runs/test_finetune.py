"""Runs that start from the network of another agent."""

import shutil

import chex
import jax
import numpy as np
import pytest

import agents
from agents import Policy
from agents.networks.agent import PARTS
from agents.runs import program
from agents.runs.folder import RunFolder
from agents.runs.session import train_run
from helpers.tiny_policy import random_params
from helpers.training import ITERATIONS, PLAIN, count_up, replace_training, small_run
from trap_tube_jax.interruptions import Stopped


def test_fine_tuning_reads_and_keeps_the_agent_and_starts_from_its_network(tmp_path, monkeypatch):
    replace_training(monkeypatch, count_up)
    path = tmp_path / "old.safetensors"
    run = small_run(finetune=path)
    policy = Policy(run.config, random_params(run.config), 9)
    agents.save(path, policy)
    with pytest.raises(Stopped):
        train_run(tmp_path / "x", run, PLAIN, stop=lambda: True)
    folder = RunFolder(tmp_path / "x")
    start = agents.load(folder.start)
    chex.assert_trees_all_equal(start.params, policy.params)
    assert (start.iteration, start.config) == (9, run.config)
    path.unlink()
    folder.metrics.unlink()  # as if killed before the first checkpoint
    shutil.rmtree(folder.checkpoints)
    train_run(folder.path, run, PLAIN)
    found = agents.load(folder.path)
    assert found.iteration == ITERATIONS
    steps = jax.tree.map(lambda x, y: x - y, found.params, policy.params)
    assert all(np.allclose(leaf, ITERATIONS, atol=1e-4) for leaf in jax.tree.leaves(steps))


def test_fine_tuning_with_the_same_seed_draws_other_tasks():
    run = small_run()
    shared = program.Program(run.config, PLAIN)
    first = shared.init(run.seed)
    params = {part: first.params[part] for part in PARTS}
    second = shared.init(run.seed, Policy(run.config, params, 0))
    chex.assert_trees_all_equal({part: second.params[part] for part in PARTS}, params)
    trained = jax.tree.map(lambda x: x + 1, params)
    third = shared.init(run.seed, Policy(run.config, trained, 0))
    keys = {jax.random.key_data(state.key).tobytes() for state in (first, second, third)}
    assert len(keys) == 3


def test_an_agent_of_another_network_is_not_fine_tuned(tmp_path):
    run = small_run(finetune="fast-base")
    with pytest.raises(ValueError, match=r"another network: .* is float32.*hidden=64, not 4"):
        train_run(tmp_path / "x", run, PLAIN)
    assert not RunFolder(tmp_path / "x").config.exists()
