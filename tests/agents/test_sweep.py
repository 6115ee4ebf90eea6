"""Sweeps: the grid, the processes, and the table of what came of it."""

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

import agents
from agents import Config, sweep, train
from agents.experiments import workers
from agents.experiments.training import plan_runs
from agents.runs.folder import Run, RunFolder, is_done, write_json
from agents.runs.metrics import MetricsLog, read_metrics
from agents.runs.stopping import Stopped, StopSignals
from paths import ROOT

SMALL = (
    "filters=[2,2]",
    "hidden=4",
    "embedding=2",
    "episodes_per_iteration=8",
    "minibatch_size=4",
    "max_steps=6",
)

# In the place of training: ends at once, badly if its name says so, or waits to be stopped.
FAKE = """
import pathlib, signal, sys
folder = pathlib.Path(sys.argv[1])
def stop(*_):
    (folder / "ended").write_text("stopped")
    sys.exit(143)
signal.signal(signal.SIGTERM, stop)
(folder / "begun").touch()
if sys.argv[2] == "wait":
    while True:
        signal.pause()
if folder.name.startswith("bad"):
    sys.exit("no such luck")
(folder / "ended").write_text("done")
"""


def options(*settings, **given):
    return sweep.Options(settings=(*SMALL, *settings), **given)


def test_the_grid_holds_every_combination():
    configs = options("learning_rate=1e-3,3e-4", "curiosity=icm,none", "clip_eps=0.3").configs()
    assert list(configs) == [
        "learning_rate=0.001,curiosity=icm",
        "learning_rate=0.001,curiosity=none",
        "learning_rate=0.0003,curiosity=icm",
        "learning_rate=0.0003,curiosity=none",
    ]
    config = configs["learning_rate=0.0003,curiosity=icm"]
    assert (config.learning_rate, config.curiosity, config.clip_eps) == (3e-4, "icm", 0.3)
    assert (config.filters, config.compile_quickly) == ((2, 2), True)


def test_lists_and_truth_values_are_values_too():
    configs = sweep.Options(
        settings=("filters=[2,3],[4,5]", "align_to_food=true,false"), env="sy"
    ).configs()
    assert next(iter(configs)) == "filters=2x3,align_to_food=true"
    config = configs["filters=4x5,align_to_food=false"]
    assert (config.filters, config.align_to_food, config.env_id) == (
        (4, 5),
        False,
        "SymbolicTrapTube-v0",
    )
    assert list(sweep.Options(settings=("clip_eps=0.3",), preset="paper").configs()) == ["paper"]


def test_modules_of_ones_own_are_imported_first():
    given = sweep.Options(
        settings=("curiosity=none,icm",), env="near-food", imports=("agents.examples.near_food",)
    )
    config = given.configs()["curiosity=none"]
    assert (config.env_id, config.imports) == ("NearFood-v0", ("agents.examples.near_food",))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--settings", "clip"], "NAME=VALUE,VALUE, got 'clip'"),
        (["--settings", "clip="], "NAME=VALUE,VALUE, got 'clip='"),
        (["--settings", "clip_eps=1", "clip_eps=2"], "a setting may be given only once"),
        (["--env", "sy", "--settings", "env_id=p"], "give --env sy or the setting env_id"),
        (["--settings", "klip=1,2"], "did you mean 'clip'"),
        (["--settings", "curiosity=rnd,rdn"], "unknown curiosity 'rdn'"),
        (["--settings", "env_id=base,p", "curiosity=counts"], "'counts' needs tasks that return"),
        (["--seeds", "0"], "seeds must be >= 1, got 0"),
        (["--processes", "0"], "processes must be >= 1, got 0"),
        (["--name", "a/b"], "name of a folder"),
    ],
)
def test_impossible_sweeps_are_refused(capsys, tmp_path, arguments, words):
    with pytest.raises(SystemExit) as stopped:
        sweep.main([*arguments, "--out", str(tmp_path)])
    assert stopped.value.code == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def planned(root, *names, seeds=1):
    return plan_runs(root, dict.fromkeys(names, Config(iterations=3)), "paper", range(seeds))


def fake(monkeypatch, how):
    command = lambda folder, *_: [sys.executable, "-c", FAKE, str(folder.path), how]  # noqa: E731
    monkeypatch.setattr(workers, "_command", command)
    monkeypatch.setattr(workers, "POLL_SECONDS", 0.01)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="cores cannot be chosen")
def test_runs_share_the_cores_and_failures_do_not_stop_the_others(tmp_path, monkeypatch):
    fake(monkeypatch, "end")
    monkeypatch.setattr(workers, "available_cores", lambda: cores)
    given = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, own: given.append(list(own)))
    cores = [0, 1, 2]
    runs = planned(tmp_path, "good", "bad", seeds=2)
    console = Console(record=True, force_terminal=False)
    failed = workers.train_runs(runs, 2, console, StopSignals(lambda: None))
    assert sorted(folder.path.name for folder in failed) == ["bad-seed0", "bad-seed1"]
    assert "no such luck" in failed[0].log.read_text()
    assert sorted(path.parent.name for path in tmp_path.glob("*/ended")) == [
        "good-seed0",
        "good-seed1",
    ]
    assert sorted(given[:2]) == [[0, 2], [1]]
    assert len(given) == 4
    assert "good-seed1: done" in console.export_text()


def test_a_request_stops_all_and_starts_no_more(tmp_path, monkeypatch):
    fake(monkeypatch, "wait")
    stop = StopSignals(lambda: None)
    begun = lambda: len(list(tmp_path.glob("*/begun")))  # noqa: E731

    def wait(seconds):
        if begun() == 3:
            stop.received = signal.SIGTERM
        sleep(seconds)

    sleep = time.sleep
    monkeypatch.setattr(workers.time, "sleep", wait)
    with pytest.raises(Stopped):
        workers.train_runs(planned(tmp_path, "a", seeds=5), 3, Console(quiet=True), stop)
    assert [path.read_text() for path in tmp_path.glob("*/ended")] == ["stopped"] * 3
    assert begun() == 3


@pytest.fixture
def finished(tmp_path):
    """Two points with two seeds each; one seed of `b` has not been trained."""
    for folder, run in planned(tmp_path, "clip_eps=1", "clip_eps=2", seeds=2):
        if folder.path.name == "clip_eps=2-seed1":
            continue
        solved = folder.path.name.startswith("clip_eps=1")
        log = MetricsLog(folder.metrics)
        for iteration in (1, 2, 3):
            row = {"seed": run.seed, "iteration": iteration, "transitions": 50 * iteration}
            row |= {"episodes": (10 + run.seed) * iteration, "success": 0.5, "seconds": 1.5}
            log.append([row | {"evaluation": float(solved and iteration > 1)}])
        first = {"iteration": 2, "episodes": 1, "transitions": 1, "seconds": 1.0}
        seeds = [{"seed": run.seed, "episodes": 3, "first_solved": first if solved else None}]
        write_json(folder.summary, {"iterations": 3, "seeds": seeds})
        sets = [{"set": "base", "percent": 100.0 * solved}, {"set": "p", "percent": 4.0 + run.seed}]
        policy = {"policy": f"seed {run.seed}", "iteration": 3, "sets": sets}
        write_json(folder.evaluation, [policy])
    return tmp_path


def test_results_are_plain_records(finished):
    records = agents.results(finished)
    kinds = {type(value) for record in records for value in record.values()}
    assert kinds == {str, int, float, bool, tuple, type(None)}
    assert [(Path(record["run"]).name, record["seed"]) for record in records] == [
        ("clip_eps=1-seed0", 0),
        ("clip_eps=1-seed1", 1),
        ("clip_eps=2-seed0", 0),
        ("clip_eps=2-seed1", 1),
    ]
    assert len({tuple(record) for record in records}) == 1
    known = {
        "preset": "paper",
        "curiosity": "icm",
        "clip_eps": 0.2,
        "finished": True,
        "trained_iterations": 3,
        "trained_episodes": 33,
        "trained_transitions": 150,
        "trained_seconds": 1.5,
        "success": 0.5,
        "evaluation": 1.0,
        "solved_iterations": 2,
        "solved_episodes": 22,
        "solved_transitions": 100,
        "percent_base": 100.0,
        "percent_p": 5.0,
    }
    assert {name: records[1][name] for name in known} == known
    unknown = {"finished": False, "trained_iterations": 0, "solved_episodes": None}
    unknown |= {"evaluation": None, "percent_p": None}
    assert {name: records[3][name] for name in unknown} == unknown


def test_a_run_is_done_when_it_has_reached_the_threshold_of_now(finished):
    (folder, run), *_ = planned(finished, "clip_eps=1")

    def done(share, iterations=9):
        config = Config(iterations=iterations, stop_when_solved=share)
        return is_done(folder, dataclasses.replace(run, config=config))

    assert done(0.5)
    assert done(1.0)
    assert not done(0.0)
    assert done(0.0, iterations=3)
    folder.metrics.write_text(folder.metrics.read_text().replace(",1.0\n", ",0.75\n"))
    assert done(0.75)
    assert not done(1.0)  # its summary says that it was solved, by a lower threshold
    MetricsLog(folder.metrics, last_iteration=3).append(
        [{**read_metrics(folder.metrics)[-1], "iteration": 4, "evaluation": 1.0}]
    )
    assert not done(1.0)  # and so it does while the run is trained on


def test_evaluations_of_runs_that_are_extended_are_out_of_date(finished):
    folder = RunFolder(finished / "clip_eps=1-seed0")
    row = read_metrics(folder.metrics)[-1]
    MetricsLog(folder.metrics, last_iteration=3).append([{**row, "iteration": 4}])
    records = agents.results(finished)
    assert [record["percent_base"] for record in records] == [None, 100.0, 0.0, None]


def test_results_of_several_folders(finished, tmp_path):
    first, second = finished / "clip_eps=2-seed0", finished / "clip_eps=1-seed1"
    records = agents.results([first, str(second)])
    assert [record["run"] for record in records] == [str(first), str(second)]
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="empty holds no run"):
        agents.results([first, tmp_path / "empty"])


def test_a_sweep_ends_in_a_table_and_a_figure(finished):
    console = Console(record=True, width=200)
    sweep.report(finished, console)
    lines = (finished / "table.md").read_text().splitlines()
    heads, _, one, two = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]]
    assert heads[:2] == ["settings", "seeds"]
    assert heads[-2:] == ["base %", "p %"]
    assert "mean ± sd [95 % confidence interval" in lines[0]
    assert one[:5] == ["clip_eps=1", "2", "2", "2", "21 ± 1 [8, 34]"]
    assert one[5:] == [*["100.0 ± 0.0 [100.0, 100.0]"] * 2, "4.5 ± 0.7 [0.0, 10.9]"]
    assert two == ["clip_eps=2", "2", "1", "0", "–", "0.0", "0.0", "4.0"]
    assert (finished / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert len(json.loads((finished / "results.json").read_text())) == 4
    assert "clip_eps=1" in console.export_text()


def start(out):
    command = [
        *(sys.executable, "-m", "agents.sweep", "--preset", "paper", "--settings"),
        *(*SMALL, "iterations=40", "eval_episodes=2", "epochs=1", "curiosity=e3b,none"),
        *("--name", "x", "--out", out, "--processes", "2"),
    ]
    flags = "--xla_backend_optimization_level=0"
    return subprocess.Popen(
        [str(part) for part in command],
        cwd=ROOT,
        env={**os.environ, "XLA_FLAGS": flags},
    )


def test_runs_stop_when_their_sweep_is_gone():
    program = "from agents.experiments import workers; workers._stop_with_parent()"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, check=False)
    assert done.returncode == -signal.SIGTERM


@pytest.mark.slow
def test_stopped_sweeps_continue_to_the_same_result(tmp_path):
    names = ("curiosity=e3b-seed0", "curiosity=none-seed0")
    assert start(tmp_path / "whole").wait() == 0
    process, root = start(tmp_path / "stopped"), tmp_path / "stopped" / "x"
    while not all(len(read_metrics(root / name / "metrics.csv")) > 3 for name in names):
        with contextlib.suppress(subprocess.TimeoutExpired):
            pytest.fail(f"ended with {process.wait(0.1)}")
    process.terminate()
    assert process.wait() == 128 + signal.SIGTERM
    assert not (root / "table.md").exists()
    assert start(tmp_path / "stopped").wait() == 0
    for name in names:
        whole, again = (
            read_metrics(tmp_path / folder / "x" / name / "metrics.csv")
            for folder in ("whole", "stopped")
        )
        timing = ("seconds", "transitions_per_second")
        untimed = [[{k: r[k] for k in r if k not in timing} for r in x] for x in (whole, again)]
        assert untimed[0] == untimed[1]
        assert len(whole) == 40
    assert (root / "table.md").is_file()


def test_a_worker_is_told_of_every_limit_that_may_have_changed(tmp_path):
    before = Run(Config(episodes_per_iteration=8, minibatch_size=8, max_transitions=900))
    folder = RunFolder.create(tmp_path / "x", before)
    for limits in ({"max_transitions": None, "stop_when_solved": 0.5}, {"max_transitions": 4000}):
        run = dataclasses.replace(before, config=dataclasses.replace(before.config, **limits))
        _, _, _, *arguments = workers._command(folder, run)
        _, options = train.parse(train.select(arguments), arguments)
        assert options.config == run.config
