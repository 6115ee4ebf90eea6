"""The page on own curiosities, encoders and tasks: its module and its commands, as they are."""

import dataclasses
import json
import re
import runpy
import shlex
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_train import TINY, final_state, run, untimed

import agents
import trap_tube_jax as tt
from agents import Config, evaluate, make_train, registry
from agents.acting.policy_files import save_policy
from agents.runs.folder import Run, RunFolder
from agents.train import main, parse, select
from paths import ROOT
from refusal import assert_refused, refused
from trap_tube_jax.imports import import_modules

PAGE = (ROOT / "agents" / "extending.md").read_text()
SIZES = TINY[: TINY.index("--max-steps")] + TINY[TINY.index("--max-steps") + 2 :]


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)


(MODULE,) = blocks("python")
(TRAIN, RESUME, EVALUATE), (EXPERIMENT,) = (block.splitlines() for block in blocks("bash"))


@pytest.fixture
def own_tables(monkeypatch, own_task_sets):
    """What a test registers or imports is gone after it."""
    for table in (registry.curiosities, registry.encoders):
        monkeypatch.setattr(table, "_factories", dict(table._factories))
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    sys.modules.pop("my_module", None)


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "my_module.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(line, *arguments, folder):
    """A line of the page, as a process in the folder, with these arguments besides."""
    python, dash_m, module, *rest = shlex.split(line)
    assert (python, dash_m) == ("python", "-m")
    return run(module, *rest, *arguments, cwd=folder)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Where the page's first command has trained for one short iteration."""
    folder = tmp_path_factory.mktemp("extending")
    (folder / "my_module.py").write_text(MODULE)
    command(TRAIN, *SIZES, "--iterations", "1", folder=folder)
    return folder


def test_the_pages_module_is_trained_with_and_remembered(trained, own_tables, monkeypatch):
    monkeypatch.chdir(trained)
    folder = Path("runs") / "fast-cold-0"
    stored = json.loads((folder / "config.json").read_text())["config"]
    assert (stored["imports"], stored["max_steps"]) == (["my_module"], None)
    assert (stored["curiosity"], stored["encoder"]) == ("tool-moved", "flat")
    (row,) = untimed(folder)
    assert 6 < float(row["episode_length"]) <= 30
    assert float(row["intrinsic_reward"]) > 0
    assert "my_module" not in sys.modules
    policy = agents.load(folder)
    assert "my_module" in sys.modules
    arguments = shlex.split(RESUME)[3:]
    _, options = parse(select(arguments), arguments)
    assert options.config == dataclasses.replace(policy.config, iterations=200)
    save_policy(folder / "mine.safetensors", policy)
    assert agents.load(folder / "mine.safetensors").config == policy.config
    _, timestep = tt.make("cold").reset(jax.random.key(0))
    action, _ = policy.act(timestep.observation[None], policy.initial(1))
    assert action.shape == (1, 2)


@pytest.mark.slow
def test_the_pages_other_commands_run(trained):
    command(RESUME, "--iterations", "2", folder=trained)
    assert final_state(trained / "runs" / "fast-cold-0")[0] == 2
    command(EVALUATE, "--json", "table.json", folder=trained)
    (table,) = json.loads((trained / "table.json").read_text())
    assert [score["set"] for score in table["sets"]] == ["cold", "base", "p"]


def test_the_pages_curiosity_pays_for_a_moved_tool(here, own_tables):
    config = Config(
        imports=("my_module",),
        env_id="cold",
        curiosity="tool-moved",
        encoder="flat",
        episodes_per_iteration=4,
        minibatch_size=2,
        hidden=4,
        embedding=2,
        encode_chunk_size=4,
    )
    learner = make_train(config)
    assert learner.env.max_steps == 30
    start = learner.init(jax.random.key(0))
    assert start.params["encoder"]["params"]["Dense_0"]["kernel"].shape == (432, 4)
    keys = jax.random.split(jax.random.key(1), 4)
    trajectory = jax.jit(learner.play)(start.params, keys, jax.random.key(2))
    assert trajectory.episodes.action.shape == (30, 4, 2)
    cells = jnp.zeros((31, 4, 3, 2), jnp.uint8).at[5:, 2, 1, 0].set(1)
    trajectory = trajectory._replace(episodes=trajectory.episodes._replace(cells=cells))
    reward, _ = learner.intrinsic_reward(start, trajectory)
    np.testing.assert_array_equal(np.argwhere(reward), [[4, 2]])


def test_a_script_may_load_a_run_that_imports_its_own_file(here, own_tables):
    runpy.run_path("my_module.py", run_name="__main__")
    assert registry.curiosities.factory("tool-moved").__module__ == "__main__"
    Config(imports=("my_module",), env_id="cold", curiosity="tool-moved", encoder="flat")
    assert registry.curiosities.factory("tool-moved").__module__ == "my_module"


def test_missing_modules_are_named(tmp_path, monkeypatch, capsys, own_tables):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder.create(tmp_path / "runs" / "x", Run(Config()))
    values = json.loads(folder.config.read_text())
    values["config"]["imports"] = ["absent_module"]
    folder.config.write_text(json.dumps(values))
    reason = f"cannot import 'absent_module': there is no module 'absent_module' in {tmp_path}"
    for arguments in (["--resume", "--name", "x"], ["--import", "absent_module"]):
        assert reason in refused(capsys, main, *arguments)
    assert reason in refused(capsys, evaluate.main, "runs/x")
    words = ["x needs a module of yours: cannot import", "put that on PYTHONPATH"]
    assert_refused(words, agents.load, tmp_path / "runs" / "x")
    (tmp_path / "needs_more.py").write_text("import absent_module")
    with pytest.raises(ValueError, match="'needs_more': there is no module 'absent_module' in "):
        Config(imports=("needs_more",))
    with pytest.raises(ValueError, match=r"cannot import '\./x\.py': name a module"):
        import_modules(["./x.py"])
    with pytest.raises(ValueError, match=r"imports must be tuple\[str, \.\.\.\], got \('a', 3\)"):
        Config.from_dict({"imports": ["a", 3]})


def test_another_module_is_another_run(here, capsys, own_tables):
    (here / "other.py").write_text("")
    RunFolder.create(here / "runs" / "x", Run(Config(imports=("my_module",))))
    message = refused(capsys, main, "--resume", "--name", "x", "--import", "other")
    assert "the run has imports=('my_module',), not ('other',)" in message


def test_unknown_encoders_are_refused(capsys):
    with pytest.raises(ValueError, match="unknown encoder 'flat'; allowed: paper, objects"):
        Config(encoder="flat")
    assert "unknown encoder 'flat'" in refused(capsys, main, "--encoder", "flat")


@pytest.mark.slow
def test_the_pages_experiment_runs(here):
    settings = [
        "episodes_per_iteration=2",
        "minibatch_size=2",
        "epochs=1",
        "filters=[2,2]",
        "hidden=4",
        "embedding=2",
    ]
    counts = ["--seeds", 1, "--iterations", 1, "--tasks", 2, "--reported", 2]
    rest = ["--settings", *settings, *counts]
    output = command(EXPERIMENT, *rest, folder=here)
    record = json.loads((here / "runs" / "exp1-fast-cold" / "summary.json").read_text())
    assert [entry["name"] for entry in record["algorithms"]] == ["ppo", "ppo+tool-moved"]
    assert {name: about["max_steps"] for name, about in record["sets"].items()} == {
        "cold": 30,
        "base": 50,
    }
    assert "--import my_module --train-set cold --sets cold base" in record["command"]
    assert "cold solved; episodes to solve it" in output
    assert "paper" not in [row.partition("|")[0] for row in output.splitlines()]
