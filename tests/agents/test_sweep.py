"""Sweeps: outcomes, stops, refusals, and one grid from its command to its table."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

from agents import experiments, sweep
from agents.config import Config
from agents.files import lock_folder
from agents.runs.folder import RunFolder
from agents.runs.run import Run, RunOptions
from agents.sweeps import launcher, overview, workers
from agents.sweeps.grids import GRIDS, Grid, Options
from agents.sweeps.launcher import launch
from helpers import small_runs
from helpers.paths import ROOT
from helpers.refusal import assert_refused, refused
from trap_tube_jax.interruptions import Stopped

SETTINGS = [
    f"{name}={json.dumps(value, separators=(',', ':'))}"
    for name, value in small_runs.SETTINGS.items()
]
NEAR_FOOD = ["--import", "agents.examples.near_food", "--env", "near-food", "--sets", "near-food"]


def launch_three(monkeypatch, tmp_path, train_runs, names=("a", "b", "c")):
    """Launches runs in a thread; returns the failed ones' names and what was printed."""
    monkeypatch.setattr(workers, "train_runs", train_runs)
    console = Console(record=True, width=60)
    runs = {tmp_path / name: Run(Config()) for name in names}
    with ThreadPoolExecutor(1) as executor:
        failed = launch(runs, RunOptions(), executor, console)
    return [path.name for path in failed], console.export_text()


def end(path):
    """Writes the files of a run that has ended."""
    tested = {"purpose": "test", "task_set": "base", "tasks": 1, "solved": 0}
    few = {"layouts": "", "layouts_total": ""}
    evaluations = [{"iteration": 250, **tested, **few}]
    small_runs.stored_run(path, Run(Config()), [small_runs.metrics_row(250)], evaluations)


def test_failures_are_shown_and_the_others_go_on(monkeypatch, tmp_path):
    """A run is done only if its files say so."""

    def train_runs(runs, options, *, consoles, stop):
        del options, consoles, stop
        ((path, _),) = runs.items()
        if path.name == "b[red]":
            return {path: ValueError("no such luck")}
        if path.name != "c":
            end(path)
        return {path: None}

    names = ("a", "b[red]", "c", "d")
    failed, shown = launch_three(monkeypatch, tmp_path, train_runs, names)
    assert failed == ["b[red]", "c"]
    failure = f"b[red]: failed: no such luck; see {tmp_path / 'b[red].log'}"
    for words in ("a: done", failure, "c: failed: its worker", "[4/4] d: done"):
        assert words in shown


def test_workers_may_run_in_another_folder(monkeypatch, tmp_path):
    found = []
    monkeypatch.chdir(tmp_path)

    def train_runs(runs, *_, stop, **__):
        found.extend(runs)
        return dict.fromkeys(runs, Stopped(2))

    launch_three(monkeypatch, Path(), train_runs, "a")
    assert found == [tmp_path / "a"]


def test_a_signal_stops_all_runs_and_they_go_on_with_the_next_launch(monkeypatch, tmp_path):
    begun = []

    def train_runs(runs, options, *, consoles, stop):
        del options, consoles
        begun.extend(path.name for path in runs)
        os.kill(os.getpid(), signal.SIGTERM)  # asks the launcher, in the main thread
        while not stop():
            pass
        return dict.fromkeys(runs, Stopped(signal.SIGTERM))

    with pytest.raises(Stopped):
        launch_three(monkeypatch, tmp_path, train_runs)
    assert begun == ["a"]

    def train(runs, *_, **__):
        begun.extend(path.name for path in runs)
        for path in runs:
            end(path)
        return dict.fromkeys(runs)

    assert launch_three(monkeypatch, tmp_path, train)[0] == []
    assert begun == ["a", "a", "b", "c"]


class Lost(Executor):
    """An executor whose calls are lost, as by a Dask cluster without its scheduler."""

    def submit(self, function, /, *args, **kwargs):
        call = Future()
        call.cancel()
        call.set_running_or_notify_cancel()
        return call


def test_calls_that_are_lost_are_failures_unless_their_runs_have_ended(tmp_path):
    runs = {tmp_path / name: Run(Config()) for name in "ab"}
    end(tmp_path / "a")
    console = Console(record=True)
    assert launch(runs, RunOptions(), Lost(), console) == [tmp_path / "b"]
    assert "b: failed: its worker, or the scheduler" in console.export_text()
    assert not (tmp_path / ".launch").exists(), "orphans stop"


def test_workers_obey_the_present_launch(tmp_path):
    first = workers.Launch.begin(tmp_path)
    assert not first.has_ended()
    second = workers.Launch.begin(tmp_path)
    assert (first.has_ended(), second.has_ended()) == (True, False)
    second.end()
    assert second.has_ended()


@pytest.mark.parametrize(
    ("backend", "preset", "devices", "size", "groups"),
    [
        ("gpu", "best", None, None, [[0, 1, 2]]),
        ("gpu", "best", None, 2, [[0, 1], [2]]),
        ("gpu", "best", 2, None, [[0], [1], [2]]),
        ("gpu", "fast", None, None, [[0], [1], [2]]),
        ("cpu", "best", None, None, [[0], [1], [2]]),
        ("cpu", "fast", None, 3, [[0, 1, 2]]),
    ],
)
def test_seeds_share_a_program_where_that_pays(
    monkeypatch, tmp_path, backend, preset, devices, size, groups
):
    """By the workers' kind of device; the launcher has no other than a CPU."""
    monkeypatch.setattr(launcher, "backend_of", lambda executor: backend)
    points = {"a": {"curiosity": "none"}, "b": {"curiosity": "effects"}}
    given = Options(preset=preset, seeds=3, out=tmp_path)
    runs = Grid(points=points).make_runs("x", given, RunOptions())
    found = launcher.group_runs(runs, RunOptions(devices=devices), Lost(), size)
    for name in points:
        of_point = [[run.seed for run in g.values() if run.algorithm == name] for g in found]
        assert [seeds for seeds in of_point if seeds] == groups


def test_the_progress_of_a_grid_fits_a_terminal(tmp_path):
    runs = {tmp_path / name: Run(Config(iterations=4)) for name in "ab"}
    console = Console(record=True, width=80)
    end(tmp_path / "a")
    with overview.Overview(console, runs):
        pass
    text = "12% of 2 run(s), time left is known after the first iterations\n"
    assert console.export_text() == text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--settings", "clip_eps"], "NAME=VALUE,VALUE, got 'clip_eps'"),
        (["--settings", "clip_eps=1", "--settings", "clip_eps=2"], "give a setting only once"),
        (["--settings", "max_transitions=5"], "max_transitions must allow an iteration"),
        (
            [*NEAR_FOOD, "--only", "x"],
            "no point 'x'; allowed: fast",
        ),  # it registers the set
        (["--seeds", "0"], "seeds must be an integer >= 1, got 0"),
        (["--processes", "0"], "processes must be an integer >= 1, got 0"),
        (["--seeds-per-program", "0"], "seeds_per_program must be an integer"),
        (["--name", "a/b"], "folder's name"),
        (
            ["--env", "sy", "--settings", "env_id=p"],
            "give --env or --settings env_id=..., not both",
        ),
    ],
)
def test_impossible_sweeps_are_refused_and_leave_nothing(
    capsys, fresh_task_sets, tmp_path, arguments, words
):
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
    with lock_folder(tmp_path / "sweep-fast-base"):
        message = refused(capsys, sweep.main, "--out", tmp_path, "--processes", "1")
    assert "is being written by another process" in message


def test_named_grids_are_known_and_their_points_are_fixed(capsys):
    for arguments in ((), ("exp3",)):
        listed = refused(capsys, experiments.main, *arguments)
        for name, grid in GRIDS.items():
            assert f"{name} " in listed
            assert grid.about in listed
    message = refused(capsys, experiments.main, "exp1", "--settings", "curiosity=rnd")
    assert "the grid's points decide curiosity; use --only" in message


def test_a_grid_whose_runs_fail_before_their_first_iteration_has_no_table(
    capsys, monkeypatch, tmp_path
):
    """Not even after a killed worker left the file of metrics without rows."""
    root = tmp_path / "x"

    def fail(runs, *_):
        for path in runs:
            path.mkdir(parents=True)
            RunFolder(path).metrics.touch()
        return list(runs)

    monkeypatch.setattr(sweep, "launch", fail)
    with pytest.raises(SystemExit) as exit_info:
        sweep.main(["--processes", "1", "--out", str(tmp_path), "--name", "x"])
    assert exit_info.value.code == 1
    assert not list(root.glob("*.csv"))
    assert "Traceback" not in capsys.readouterr().err


def test_a_grid_from_its_command_to_its_table(capsys, tmp_path):
    root = tmp_path / "x"
    command = ["--processes", "1", "--out", str(tmp_path), "--name", "x", "--no-report"]
    command += ["--sets", "base", "p", "--evaluate-every", "1", "--test-tasks", "3"]
    command += ["--settings", *SETTINGS, "iterations=2", "max_transitions=null,1000000"]
    command += ["--only", "max_transitions=null"]

    def run():
        sweep.main(command)
        progress, _, tables = capsys.readouterr().out.partition("Training\n")
        assert f"1 run(s), up to 1 at a time; logs: {root}/*.log\n" in progress
        assert "[1/1] max_transitions=null-seed0: done" in progress
        return (root / "results.csv").read_text(), tables

    _, shown = first = run()
    assert str(root / "table.md") in shown
    assert run() == first, "nothing is left to do"
    rows = pd.read_csv(root / "results.csv")
    assert {len(group) for _, group in rows.groupby(["purpose", "iteration"])} == {2}
    tested = rows[rows["purpose"] == "test"].set_index("task_set")
    assert tested["tasks"].to_dict() == {"base": 1, "p": 3}
    assert {"run", "algorithm", "seed", "commit", "clip_eps", "solved", "length"} <= set(rows)
    about = json.loads((root / "grid.json").read_text())
    assert (about["train_set"], about["settings"]["hidden"]) == ("base", 4)
    assert "| max_transitions=null |" in (root / "table.md").read_text()


DIES_ONCE = """
import os, pathlib, signal
from agents.runs.progress import Progress

save, marker = Progress.save, pathlib.Path({marker!r})

def save_and_die(self):
    save(self)
    if self.iteration == 4 and "seed1" in self.folder.path.name and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)

if "dask" in __import__("sys").modules:
    Progress.save = save_and_die
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


CLUSTER = """
import distributed
if __name__ == "__main__":
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as c:
        print(c.scheduler_address, flush=True)
        input()
"""


@pytest.fixture
def cluster(tmp_path):
    """A process of a Dask cluster with one worker, and its address."""
    pytest.importorskip("distributed")
    (tmp_path / "cluster.py").write_text(CLUSTER)
    process = subprocess.Popen(
        [sys.executable, tmp_path / "cluster.py"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    with process:
        yield process, process.stdout.readline().strip()
        process.kill()


def start_endless(tmp_path, *arguments):
    """Starts a sweep of two runs without an end; returns it when the first has trained."""
    command = ["--seeds", 2, "--out", tmp_path, "--name", "x", "--sets", "base", *arguments]
    settings = ["--settings", *SETTINGS, "iterations=1000000", "stop_when_solved=0"]
    process = small_runs.start("agents.sweep", *command, *settings)
    while not (tmp_path / "x" / "fast-seed0" / "metrics.csv").exists():
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.2)
            pytest.fail(str(process.communicate()))
    return process


@pytest.mark.slow
def test_a_lost_scheduler_is_a_failure(tmp_path, cluster):
    process, address = cluster
    sweep_process = start_endless(tmp_path, "--cluster", address)
    process.kill()
    output, errors = sweep_process.communicate()
    assert sweep_process.returncode == 1, errors
    for seed in range(2):
        assert f"fast-seed{seed}: failed" in output
    assert "Unfinished" in output
    assert not (tmp_path / "x" / ".launch").exists(), "its workers would train on"


@pytest.mark.slow
def test_a_run_of_a_lost_launcher_goes_on_with_the_next(tmp_path, cluster):
    """The cluster's worker trains on, until the same command is given again."""
    arguments = ["--cluster", cluster[1]]
    lost = start_endless(tmp_path, *arguments)
    lost.kill()
    lost.communicate()
    folder = tmp_path / "x" / "fast-seed0"
    assert_refused(["is being written"], lock_folder(folder).__enter__)
    process = start_endless(tmp_path, *arguments)
    log = workers.log_of(folder)
    while log.read_text().count("Compiling") < 2:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.2)
            pytest.fail(str(process.communicate()))
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate()
    assert (process.returncode, output.count(": stopped\n")) == (130, 2), errors
    iterations = [row["iteration"] for row in small_runs.untimed(folder)]
    assert iterations == list(map(str, range(1, len(iterations) + 1)))
    assert small_runs.final_state(folder)[0] == len(iterations)


@pytest.mark.slow
@pytest.mark.parametrize("signals", [1, 2])
@pytest.mark.parametrize("where", ["here", "on a cluster"])
def test_ctrl_c_ends_a_sweep(request, tmp_path, where, signals):
    """The second run is queued."""
    workers_of = ["--processes", 1]
    if where == "on a cluster":
        workers_of = ["--cluster", request.getfixturevalue("cluster")[1]]
    process = start_endless(tmp_path, *workers_of)
    assert process.stderr is not None
    for _ in range(signals):
        process.send_signal(signal.SIGINT)
        process.stderr.readline()
    output, errors = process.communicate()
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert not (tmp_path / "x" / ".launch").exists(), "its workers would train on"
    if signals == 1:
        assert output.count(": stopped\n") == 2
        folder = tmp_path / "x" / "fast-seed0"
        assert small_runs.final_state(folder)[0] == len(small_runs.untimed(folder))
        assert not (tmp_path / "x" / "fast-seed1").exists()
