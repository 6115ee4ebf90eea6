"""Runs the module and the commands of extending.md as they are printed."""

import os
import re
import shlex
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import agents
import trap_tube_jax as tt
from agents import make_learner, train
from agents.files import read_json
from agents.runs.folder import RunFolder
from agents.runs.run import Run, RunOptions
from agents.train import main
from helpers.jax_settings import HAS_DEFAULT_DRAWS
from helpers.paths import ROOT
from helpers.refusal import assert_refused, refused
from helpers.small_runs import final_state, options, small_config, untimed
from trap_tube_jax.imports import import_modules

PAGE = (ROOT / "agents" / "extending.md").read_text()
(MODULE,), (COMMANDS,) = (
    re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    for language in ("python", "bash")
)
TRAIN, RESUME, EVALUATE = COMMANDS.splitlines()
SIZES = shlex.split(re.sub("--max-steps [0-9]+", "", " ".join(options())))


@pytest.fixture
def here(tmp_path, monkeypatch, fresh_names):
    """A folder with the page's module, which is forgotten after the test."""
    (tmp_path / "my_module.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("my_module", None)


def command(line, *arguments, folder):
    """Runs a line of the page in a folder, with these arguments besides."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    words = [sys.executable, *shlex.split(line)[1:], *arguments]
    return subprocess.run(words, cwd=folder, env=environment, check=True)


def test_a_run_records_the_module_and_needs_leave_to_import_it(here):
    command(TRAIN, *SIZES, "--iterations", "1", "--sets", "cold", "--no-report", folder=here)
    folder = here / "runs" / "fast-cold-0"
    stored = read_json(folder / "config.json")
    assert (stored["imports"], stored["config"]["max_steps"]) == (["my_module"], None)
    (row,) = untimed(folder)
    assert 6 < float(row["episode_length"]) <= 30
    assert float(row["intrinsic_reward"]) > 0 or not HAS_DEFAULT_DRAWS

    words = ["unknown curiosity 'tool-moved'", "--import my_module"]
    assert_refused(words, agents.load, folder)
    assert "my_module" not in sys.modules
    policy = agents.load(folder, imports=("my_module",))
    assert (policy.config.curiosity, policy.config.encoder) == ("tool-moved", "flat")
    _, timestep = tt.make("cold").reset(jax.random.key(0))
    action, _ = policy.act(timestep.observation[None], policy.initial(1))
    assert action.shape == (1, 2)
    agents.save(here / "mine.safetensors", policy)
    assert agents.load(here / "mine.safetensors").config == policy.config


@pytest.mark.slow
def test_the_pages_other_commands_run(here):
    command(TRAIN, *SIZES, "--iterations", "1", folder=here)
    command(RESUME, "--iterations", "2", folder=here)
    assert final_state(here / "runs" / "fast-cold-0")[0] == 2
    command(EVALUATE, "--output", "table.csv", folder=here)
    rows = (here / "table.csv").read_text().splitlines()[1:]
    assert [name for name in ("cold", "base", "p") for row in rows if f",{name}," in row]
    assert len(rows) == 3


def test_the_pages_curiosity_pays_for_a_moved_tool(here):
    import_modules(["my_module"])
    learner = make_learner(
        small_config(env_id="cold", curiosity="tool-moved", encoder="flat", max_steps=None)
    )
    assert learner.env.max_steps == 30
    start = jax.jit(learner.init)(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 4)
    trajectory = jax.jit(learner.play)(start.params, keys, jax.random.key(2))
    assert trajectory.episodes.action.shape == (4, 30, 2)
    cells = jnp.zeros((4, 31, 3, 2), jnp.uint8).at[2, 5:, 1, 0].set(1)
    trajectory = trajectory._replace(episodes=trajectory.episodes._replace(cells=cells))
    reward, _ = jax.jit(learner.intrinsic_reward)(start, trajectory)
    np.testing.assert_array_equal(np.argwhere(reward), [[2, 4]])


def test_devices_and_processes_are_ready_before_a_module_starts_jax(here, capsys, monkeypatch):
    ready = []
    monkeypatch.setattr(
        train, "split_cpu", lambda count: ready.append((count, "my_module" in sys.modules))
    )
    monkeypatch.setattr(train.processes, "join", ready.append)
    arguments = "--import my_module --env nowhere --devices 2 --distributed a:1 2 0"
    refused(capsys, main, *arguments.split())
    sys.modules.pop("my_module")
    RunFolder(here / "x").write_config(Run(small_config()), RunOptions(devices=2))
    refused(capsys, main, "--import", "my_module", "--resume", here / "x", "--hidden", "8")
    assert ready == [(2, False), ("a:1", "2", "0"), (2, False), None]


def test_modules_that_cannot_be_imported_are_named(here, capsys):
    reason = f"cannot import 'absent_module': there is no module 'absent_module' in {here}"
    assert reason in refused(capsys, main, "--import", "absent_module")
    (here / "needs_more.py").write_text("import absent_module")
    with pytest.raises(ValueError, match="'needs_more': there is no module 'absent_module' in "):
        import_modules(["needs_more"])
    with pytest.raises(ValueError, match=r"cannot import '\./x\.py': name a module"):
        import_modules(["./x.py"])
