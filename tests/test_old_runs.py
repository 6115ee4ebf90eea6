"""A run of version 0.1.0: its policy acts as it did, and what does not open says who wrote it."""

import json
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import agents
from agents import evaluate, train
from agents.networks.agent import Agent
from agents.runs.folder import Run, RunFolder
from trap_tube_jax import __version__

STORED = Path(__file__).parent / "data" / "run_0.1.0.zip"


@pytest.fixture
def old(tmp_path):
    with zipfile.ZipFile(STORED) as archive:
        archive.extractall(tmp_path)
    return tmp_path / "run"


def test_the_policy_acts_as_it_did(old):
    policy = agents.load(old)
    assert (policy.config.env_id, policy.iteration) == ("SymbolicTrapTube-v0", 3)
    assert policy.config.bootstrap == "baseline"
    agent = Agent(policy.config)

    def outputs(params, observation, action):
        features = jax.vmap(lambda rows: agent.encode(params, rows))(observation)
        return agent.act(params, agent.unroll(params, features, action, jnp.zeros((5, 4))))

    expected = np.load(old.parent / "outputs.npz")
    found = jax.jit(outputs)(policy.params, expected["observation"], expected["action"])
    np.testing.assert_allclose(found.actions.grasp_logits, expected["grasp"], atol=1e-5)
    np.testing.assert_allclose(found.actions.move_logits, expected["move"], atol=1e-5)
    np.testing.assert_allclose(found.value[..., 0], expected["value"], atol=1e-5)
    assert np.ptp(expected["grasp"]) > 1e-3


def test_settings_that_are_gone_are_left_out_of_runs_without_a_method_too(old):
    path = old / "config.json"
    settings = json.loads(path.read_text())
    del settings["config"]["method"]
    settings["config"]["imitation_coef"] = 1.0
    path.write_text(json.dumps(settings))
    assert agents.load(old).config.env_id == "SymbolicTrapTube-v0"


def test_it_can_be_evaluated(old, capsys):
    evaluate.main([str(old), "--sets", "base"])
    assert "iteration 3" in capsys.readouterr().out


def refusal(old, capsys) -> str:
    arguments = ["--resume", "--name", old.name, "--out", str(old.parent)]
    with pytest.raises(SystemExit):
        train.main(arguments)
    return capsys.readouterr().err


def test_training_that_cannot_go_on_names_the_version(old, capsys):
    message = refusal(old, capsys)
    assert "checkpoints/3 does not fit" in message
    assert f"version 0.1.0 wrote it, this is {__version__}" in message


def test_settings_of_another_method_name_the_version(old, capsys):
    path = old / "config.json"
    settings = json.loads(path.read_text())
    settings["config"]["method"] = "dagger"
    path.write_text(json.dumps(settings))
    with pytest.raises(ValueError, match=r"unknown setting 'method'.*version 0\.1\.0 wrote it"):
        agents.load(old)
    assert "version 0.1.0 wrote it" in refusal(old, capsys)


def test_settings_say_which_version_wrote_them(tmp_path):
    run = Run(agents.Config())
    folder = RunFolder.create(tmp_path / "run", run)
    assert json.loads(folder.config.read_text())["version"] == __version__
    assert RunFolder.open(folder.path)[1] == run
    settings = json.loads(folder.config.read_text())
    settings["config"]["colour"] = "red"
    folder.config.write_text(json.dumps({**settings, "version": "9.1"}))
    with pytest.raises(ValueError, match=r"'colour'.*version 9\.1 wrote it, this is"):
        RunFolder.open(folder.path)
