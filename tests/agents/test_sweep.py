"""Sweeps: outcomes, stops, refusals, and one grid from its command to its table."""

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

import small_runs
from agents import experiments, sweep
from agents.config import Config
from agents.runs.folder import RunFolder
from agents.runs.run import Run, RunOptions
from agents.runs.stopping import Stopped
from agents.sweeps import workers
from agents.sweeps.launcher import launch
from paths import ROOT
from refusal import refused

SETTINGS = [
    f"{name}={json.dumps(value, separators=(',', ':'))}"
    for name, value in small_runs.SETTINGS.items()
]
NEAR_FOOD = ["--import", "agents.examples.near_food", "--env", "near-food", "--sets", "near-food"]


def launch_three(monkeypatch, tmp_path, train_run, names=("a", "b", "c")):
    """Launches runs in a thread; returns the failed ones' names and what was printed."""
    monkeypatch.setattr(workers, "train_run", train_run)
    console = Console(record=True, width=60)
    runs = {tmp_path / name: Run(Config()) for name in names}
    with ThreadPoolExecutor(1) as executor:
        failed = launch(runs, RunOptions(), executor, console)
    return [path.name for path in failed], console.export_text()


def test_failures_are_shown_and_the_others_go_on(monkeypatch, tmp_path):
    def train_run(path, run, options, *, console, stop_file):
        del run, options, console, stop_file
        if path.name == "b[red]":
            raise ValueError("no such luck")

    names = ("a", "b[red]", "c")
    failed, shown = launch_three(monkeypatch, tmp_path, train_run, names)
    assert failed == ["b[red]"]
    failure = f"b[red]: failed: no such luck; see {tmp_path / 'b[red].log'}"
    for words in ("a: done", failure, "[3/3] c: done"):
        assert words in shown


def test_workers_may_run_in_another_folder(monkeypatch, tmp_path):
    found = []
    monkeypatch.chdir(tmp_path)
    train_run = lambda path, *_, stop_file, **__: found.append((path, stop_file))  # noqa: E731
    launch_three(monkeypatch, Path(), train_run, "a")
    assert found == [(tmp_path / "a", tmp_path / ".stop")]


@pytest.mark.parametrize("signals", [1, 2])
def test_a_signal_stops_all_runs_and_a_second_one_at_once(monkeypatch, tmp_path, signals):
    begun = []

    def train_run(path, run, options, *, console, stop_file):
        del run, options, console
        begun.append(path.name)
        for _ in range(signals):
            os.kill(os.getpid(), signal.SIGTERM)  # asks the launcher, in the main thread
            while not stop_file.exists():
                pass
        raise Stopped(signal.SIGTERM)

    with pytest.raises(Stopped if signals == 1 else KeyboardInterrupt):
        launch_three(monkeypatch, tmp_path, train_run)
    assert begun == ["a"]
    assert (tmp_path / ".stop").exists() == (signals == 2), "else a late process would train"
    launch_three(monkeypatch, tmp_path, lambda path, *_, **__: begun.append(path.name))
    assert begun == ["a", "a", "b", "c"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--settings", "clip_eps"], "NAME=VALUE,VALUE, got 'clip_eps'"),
        (["--settings", "clip_eps="], "NAME=VALUE,VALUE, got 'clip_eps='"),
        (["--settings", "clip_eps=1", "clip_eps=2"], "give a setting only once"),
        (["--settings", "clip_eps=1", "--settings", "clip_eps=2"], "give a setting only once"),
        (["--settings", "clp_eps=1,2"], "did you mean 'clip_eps'"),
        (["--settings", "curiosity=rnd,rdn"], "unknown curiosity 'rdn'"),
        (["--settings", "max_transitions=5"], "max_transitions must allow an iteration"),
        (["--only", "fst"], "no point 'fst'; allowed: fast"),
        ([*NEAR_FOOD, "--only", "x"], "no point 'x'"),  # names of own sets are known in time
        (["--seeds", "0"], "seeds must be >= 1, got 0"),
        (["--seed", "-1"], "seed must be an integer >= 0"),
        (["--processes", "0"], "must be greater than 0"),
        (["--name", "a/b"], "folder's name"),
        (["--env", "nowhere"], "nowhere"),
    ],
)
def test_impossible_sweeps_are_refused_and_leave_nothing(
    capsys, monkeypatch, own_task_sets, tmp_path, arguments, words
):
    monkeypatch.delitem(sys.modules, "agents.examples.near_food", raising=False)
    out = tmp_path / "out"
    assert words in refused(capsys, sweep.main, *arguments, "--out", out)
    assert not out.exists()


def test_modules_are_imported_after_other_devices_are_left_to_the_runs(monkeypatch):
    order = []

    def parse_all(*_):
        order.append("modules")
        raise ValueError

    monkeypatch.setattr(sweep.jax.config, "update", lambda name, _: order.append(name))
    monkeypatch.setattr(sweep, "parse_all", parse_all)
    with pytest.raises(SystemExit):
        sweep.main([])
    assert order == ["jax_platforms", "modules"]


def test_a_grid_that_is_being_written_is_refused(capsys, tmp_path):
    with RunFolder(tmp_path / "sweep-fast-base").lock():
        message = refused(capsys, sweep.main, "--out", tmp_path, "--processes", "1")
    assert "is being written by another process" in message


def test_named_grids_are_known_and_their_points_are_fixed(capsys):
    assert "exp1,exp2,fast,best,curiosities" in refused(capsys, experiments.main, "exp3")
    assert "exp1,exp2,fast,best,curiosities" in refused(capsys, experiments.main)
    message = refused(capsys, experiments.main, "exp1", "--settings", "curiosity=rnd")
    assert "the grid's points decide curiosity; use --only" in message


def test_a_grid_from_its_command_to_its_table(capsys, tmp_path):
    root = tmp_path / "x"
    command = ["--processes", "1", "--out", str(tmp_path), "--name", "x", "--no-report"]
    command += ["--sets", "base", "p", "--evaluate-every", "1", "--test-tasks", "3"]
    command += ["--settings", *SETTINGS, "iterations=2", "max_transitions=null,1000000"]
    command += ["--only", "max_transitions=null"]

    def run():
        sweep.main(command)
        return (root / "results.csv").read_text(), capsys.readouterr().out

    _, shown = first = run()
    assert "[1/1] max_transitions=null-seed0: done" in shown
    assert str(root / "table.md") in shown
    assert run() == first, "nothing is left to do"
    rows = pd.read_csv(root / "results.csv")
    assert {len(each) for _, each in rows.groupby(["purpose", "iteration"])} == {2}
    tested = rows[rows["purpose"] == "test"].set_index("task_set")
    assert tested["tasks"].to_dict() == {"base": 1, "p": 3}
    assert {"run", "algorithm", "seed", "commit", "clip_eps", "solved", "length"} <= set(rows)
    about = json.loads((root / "grid.json").read_text())
    assert (about["train_set"], about["settings"]["hidden"]) == ("base", 4)
    assert "| max_transitions=null |" in (root / "table.md").read_text()


DIES_ONCE = """
import os, pathlib, signal
from agents.runs.session import Session

save, marker = Session._save, pathlib.Path({marker!r})

def save_and_die(self):
    save(self)
    if self.iteration == 4 and "seed1" in self.folder.path.name and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)

if "dask" in __import__("sys").modules:
    Session._save = save_and_die
"""


@pytest.mark.slow
def test_a_run_of_a_killed_dask_worker_goes_on_elsewhere(tmp_path, monkeypatch):
    """The worker of seed 1 dies after its second checkpoint, of iteration 4."""
    distributed = pytest.importorskip("distributed")
    (tmp_path / "dies_once.py").write_text(DIES_ONCE.format(marker=str(tmp_path / "died")))
    path = os.pathsep.join([str(tmp_path), str(ROOT), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.syspath_prepend(tmp_path)  # Dask hands it on to its workers
    arguments = ["--seeds", "2", "--out", str(tmp_path), "--import", "dies_once", "--no-report"]
    arguments += ["--checkpoint-every", "2", "--sets", "base", "--evaluate-every", "3"]
    arguments += ["--settings", *SETTINGS, "iterations=7"]
    command = [sys.executable, "-m", "agents.sweep", *arguments]
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        given = ["--name", "cluster", "--cluster", cluster.scheduler_address]
        subprocess.run([*command, *given], cwd=ROOT, check=True)
    subprocess.run([*command, "--name", "here", "--processes", "2"], cwd=ROOT, check=True)
    assert (tmp_path / "died").exists()
    assert small_runs.untimed(tmp_path / "cluster" / "fast-seed1") == small_runs.untimed(
        tmp_path / "here" / "fast-seed1"
    )
    rows = {name: pd.read_csv(tmp_path / name / "results.csv") for name in ("cluster", "here")}
    assert rows["cluster"].equals(rows["here"])
    assert rows["here"].groupby("purpose").size().to_dict() == {"validation": 6, "test": 2}
