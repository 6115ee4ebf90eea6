"""The command line of training: what a run leaves, stopping and resuming, and what is refused."""

import csv
import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from rich.console import Console

from agents import evaluate, train
from agents.config import PRESETS, Config
from agents.runs import compilation
from agents.runs.checkpoint import Checkpoints, digest
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import FirstSolved, MetricsLog, is_last, read_metrics
from agents.runs.progress import Progress
from agents.runs.stopping import StopSignals
from agents.train import main, open_run, parse, select
from paths import ROOT
from refusal import refused
from trap_tube_jax.scoring.tasks import ALL_SETS

TINY = [
    *(
        "--episodes-per-iteration",
        "8",
        "--minibatch-size",
        "4",
        "--epochs",
        "1",
        "--max-steps",
        "6",
        "--encode-chunk-size",
        "8",
    ),
    *("--filters", "2", "2", "--hidden", "4", "--embedding", "2", "--eval-episodes", "2"),
]
ITERATIONS = 30
TIMING_COLUMNS = ("seconds", "transitions_per_second")  # of the metrics, differ each time


def start(module, *arguments, cwd=ROOT):
    """A real process of a command line, warnings being errors."""
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", module, *map(str, arguments)],
        cwd=cwd,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            "JAX_PLATFORMS": "cpu",
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(module, *arguments, cwd=ROOT):
    process = start(module, *arguments, cwd=cwd)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert not errors
    return output


def read_iterations(process, count):
    """Reads the output up to the line of the count-th iteration, or to its end."""
    lines = []
    while count and (line := process.stdout.readline()):
        lines.append(line)
        count -= bool(re.match(r"\s+\d+ .*left at most", line))
    return "".join(lines)


def untimed(folder):
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if k not in TIMING_COLUMNS} for row in rows]


def final_state(folder):
    with Checkpoints(folder / "checkpoints") as checkpoints:
        arrays, record = checkpoints.load()
    return record["iteration"], digest(arrays)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder and the output of a run that nothing interrupts."""
    out = tmp_path_factory.mktemp("runs")
    arguments = [*TINY, "--iterations", ITERATIONS, "--name", "whole", "--out", out]
    return out / "whole", run("agents.train", *arguments)


def test_a_run_leaves_its_results_and_says_where(whole):
    folder, output = whole
    names = ["config.json", "metrics.csv", "checkpoints", "curves.png", "evaluation.json"]
    for name in [*names, "summary.json", "report.html"]:
        assert (folder / name).exists()
        assert str(folder / name) in output
    assert (folder / "curves.png").read_bytes().startswith(b"\x89PNG")
    written = [(folder / name).stat().st_mtime_ns for name in ("evaluation.json", "summary.json")]
    assert written == sorted(written)  # where there is a summary, nothing else is missing
    rows = untimed(folder)
    assert [row["iteration"] for row in rows] == [str(i + 1) for i in range(ITERATIONS)]
    assert [row["episodes"] for row in rows] == [str(8 * i + 8) for i in range(ITERATIONS)]
    (policy,) = json.loads((folder / "evaluation.json").read_text())
    assert [score["set"] for score in policy["sets"]] == list(ALL_SETS)
    assert [score["tasks"] for score in policy["sets"]] == [1] + 7 * [2]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["env_id"] == "TrapTube-v0"
    assert summary["seeds"] == [{"seed": 0, "episodes": 8 * ITERATIONS, "first_solved": None}]
    assert summary["compile_seconds"] > 0
    assert output.count("left at most") == ITERATIONS


def test_killed_runs_continue_to_the_same_bits(whole, tmp_path):
    """Killed at a moment that differs every time: a line is printed just before its save."""
    out = ["--name", "killed", "--out", tmp_path, "--checkpoint-every", 1]
    process = start("agents.train", *TINY, "--iterations", ITERATIONS, *out)
    read_iterations(process, 2)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    output = run("agents.train", "--resume", *out)
    assert re.search(r"parameters, from iteration [1-9]", output)
    assert final_state(tmp_path / "killed") == final_state(whole[0])
    assert untimed(tmp_path / "killed") == untimed(whole[0])
    for name in ("config.json", "evaluation.json"):
        assert (tmp_path / "killed" / name).read_text() == (whole[0] / name).read_text()


def test_ctrl_c_saves_and_says_how_to_continue(tmp_path):
    out = ["--name", "stopped", "--out", tmp_path]
    process = start("agents.train", *TINY, "--iterations", 100_000, *out)
    read_iterations(process, 3)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate()
    assert (process.returncode, errors) == (130, "")
    match = re.search(r"Stopped at iteration (\d+)\. Continue with: (.*)", output)
    assert match
    assert match[2] == f"python -m agents.train --resume --name stopped --out {tmp_path}"
    iteration = int(match[1])
    assert iteration >= 3
    assert final_state(tmp_path / "stopped")[0] == iteration
    assert len(untimed(tmp_path / "stopped")) == iteration


def test_evaluate_command_line(whole, tmp_path):
    folder, _ = whole
    arguments = [folder, "--sets", "base", "StructuralTrapTube-v0", "--tasks", 3]
    output = run("agents.evaluate", *arguments, "--json", tmp_path / "new/x.json", "--optimality")
    (policy,) = json.loads((tmp_path / "new/x.json").read_text())
    assert policy["iteration"] == ITERATIONS
    assert [(score["set"], score["tasks"]) for score in policy["sets"]] == [("base", 1), ("st", 3)]
    assert policy["sets"][0]["optimality"]["solvable"] == 0  # 11 steps, of which it has 6
    assert "{St} (st)" in output
    assert str(tmp_path / "new/x.json") in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--preset slow", f"unknown preset 'slow'; allowed: {', '.join(PRESETS)}"),
        ("--env q", "unknown task set 'q'; allowed: TrapTube-v0 (base), "),
        (
            "--minibatch-size 3 --episodes-per-iteration 8",
            "minibatch must divide episodes_per_iteration=8, got 3; allowed: 1, 2",
        ),
        ("--episodess 8", "Unrecognized options: --episodess, 8"),
        ("--curiosity icmm", "unknown curiosity 'icmm'; allowed: icm, "),
        ("--discount 2", "discount must lie in [0, 1], got 2"),
        ("--seed -1", "seed must be an integer >= 0, got -1"),
        ("--seeds 0", "seeds must be an integer >= 1, got 0"),
        ("--seed 2147483647 --seeds 2", "seeds must be at most 2147483647, got 2147483648"),
        ("--keep 0", "keep must be >= 1, got 0"),
        ("--checkpoint-every 0", "checkpoint_every must be >= 1, got 0"),
        ("--name a/b", "name must be the name of a folder, without a path, got 'a/b'"),
        ("--name ..", "name must be the name of a folder, without a path, got '..'"),
        ("--resume --name no", "no holds no run; runs in "),
    ],
)
def test_impossible_settings_are_refused(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, main, *arguments.split(), "--out", tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_run_is_not_overwritten(capsys, whole):
    folder, _ = whole
    out = ["--out", folder.parent, "--name", "whole"]
    assert "give --resume to continue the run in it, or another --name" in refused(
        capsys, main, *out
    )
    message = refused(capsys, main, *out, "--resume", "--hidden", 8)
    assert "the run has hidden=4, not 8; only iterations, max_transitions and stop_when" in message
    assert "the run has seed=0, not 1" in refused(capsys, main, *out, "--resume", "--seed", 1)


def test_a_folder_without_a_run_is_not_to_be_resumed(capsys, tmp_path):
    (tmp_path / "plain").mkdir()
    (tmp_path / "plain" / "x").touch()
    message = refused(capsys, main, "--name", "plain", "--out", tmp_path)
    assert "is taken, and holds no run; give another --name" in message
    assert "--resume" not in message


@pytest.mark.parametrize("saved", [0, 10])
def test_a_new_run_that_fails_before_it_saves_leaves_no_folder(saved, tmp_path, monkeypatch):
    class Failing(SimpleNamespace):
        saved, resume_command = 0, "again"

        def __init__(self, folder, run, console, **options):
            super().__init__(folder=folder, console=console, close=lambda: None)

        def train(self, stop, then_finish):
            self.saved = saved
            raise RuntimeError("broken")

    monkeypatch.setattr(train, "Session", Failing)
    command = ["--name", "x", "--out", str(tmp_path)]
    with pytest.raises(RuntimeError, match="broken"):
        train.train(command)
    assert (tmp_path / "x").exists() == (saved > 0)
    if saved:
        saved = 0  # and it fails again
        with pytest.raises(RuntimeError, match="broken"):
            train.train([*command, "--resume"])
        assert (tmp_path / "x" / "config.json").exists()


def test_a_new_run_that_cannot_start_leaves_no_folder(capsys, tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise ValueError("cannot be trained with")

    monkeypatch.setattr(train, "Session", refuse)
    command = ["--name", "x", "--out", tmp_path]
    for _ in range(2):
        assert "cannot be trained with" in refused(capsys, main, *command)
        assert not list(tmp_path.iterdir())
    RunFolder.create(tmp_path / "x", Run(Config()))
    assert "cannot be trained with" in refused(capsys, main, *command, "--resume")
    assert (tmp_path / "x" / "config.json").exists()


def test_unusable_checkpoints_are_refused(capsys, whole, tmp_path):
    RunFolder.create(tmp_path / "foreign", Run(Config()))
    shutil.copytree(whole[0] / "checkpoints", tmp_path / "foreign" / "checkpoints")
    out = ["--resume", "--name", "foreign", "--out", tmp_path]
    settings = (tmp_path / "foreign" / "config.json").read_bytes()
    assert "does not fit the run's settings" in refused(capsys, main, *out, "--iterations", 999)
    assert (tmp_path / "foreign" / "config.json").read_bytes() == settings
    message = refused(capsys, evaluate.main, tmp_path / "foreign")
    assert f"checkpoint {tmp_path}/foreign/checkpoints/{ITERATIONS} does not fit" in message
    assert "holds no run" in refused(capsys, evaluate.main, tmp_path / "none")


def parsed(*arguments):
    return parse(select([*arguments]), [*arguments])


def test_defaults_and_overrides(tmp_path):
    stored, options = parsed("--out", str(tmp_path))
    assert (options.name, options.seed, options.seeds, stored) == ("fast-base-0", 0, 1, None)
    assert options.config == Config.preset("fast")


@pytest.mark.parametrize("preset", PRESETS)
def test_what_is_asked_for_goes_before_every_preset(preset, tmp_path):
    arguments = f"--preset {preset} --env psy --seed 3 --seeds 2 --hidden 32 --curiosity none"
    _, options = parsed(*arguments.split(), "--out", str(tmp_path))
    own = {"env_id": "PerceptualSymbolicTrapTube-v0", "hidden": 32, "curiosity": "none"}
    assert options.config == Config.preset(preset, **own)
    assert options.name == f"{preset}-psy-3to4"


def test_modules_and_task_set_are_one_option_each_also_as_once_spelled(capsys):
    for arguments in (["--env", "st", "--import", "math"], ["--env-id", "st", "--imports", "math"]):
        _, options = parsed(*arguments)
        same = Config.preset("fast", env_id="StructuralTrapTube-v0", imports=("math",))
        assert (options.config, options.name) == (same, "fast-st-0")
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert text.count("--env ") == text.count("--env-id ") == 1
    assert text.count("--import ") == text.count("--imports ") == 1


def test_resumed_runs_keep_their_settings(tmp_path):
    stored = Run(Config.preset("paper", hidden=32), preset="paper", seed=5, seeds=2)
    RunFolder.create(tmp_path / "x", stored)
    arguments = ["--resume", "--name", "x", "--out", str(tmp_path)]
    found, options = parsed(*arguments)
    assert found == stored
    assert (options.config, options.seed, options.seeds) == (stored.config, 5, 2)
    _, options = parsed(*arguments, "--iterations", "999")
    assert options.config == dataclasses.replace(stored.config, iterations=999)


def test_resumed_runs_keep_their_task_set(capsys, tmp_path):
    RunFolder.create(tmp_path / "x", Run(Config()))
    arguments = ["--resume", "--name", "x", "--out", str(tmp_path)]
    message = refused(capsys, main, *arguments, "--env", "sy")
    assert "x is of TrapTube-v0, not of --env sy; leave that out, or begin a new run" in message
    assert parsed(*arguments, "--env", "base")[0] == Run(Config())


def test_a_second_ctrl_c_ends_the_process_at_once(tmp_path, monkeypatch, capsys):
    """An orderly exit would wait for what compiles in the background."""

    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    class Ended(BaseException):
        pass

    def end(code):
        raise Ended(code)

    session = SimpleNamespace(console=Console(), saved=3, resume_command="again")
    session.train, session.close = interrupted, lambda: None
    monkeypatch.setattr(train, "start", lambda arguments: session)
    monkeypatch.setattr(os, "_exit", end)
    with pytest.raises(Ended, match="130"):
        train.train([])
    assert "Stopped at iteration 3. Continue with: again" in capsys.readouterr().out


def test_after_stopping_a_further_ctrl_c_ends_the_process():
    previous = {number: signal.getsignal(number) for number in StopSignals.SIGNALS}
    try:
        stop = StopSignals(lambda: None)
        with stop:
            pass
        stop.end_process()
        assert {signal.getsignal(number) for number in previous} == {signal.SIG_DFL}
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("schedule", [{"lr_decay_fraction": 0.5}, {"intrinsic_coef_init": 3.0}])
def test_a_run_with_a_schedule_is_not_extended(tmp_path, schedule):
    """What is scheduled has been falling towards the last iteration that was known then."""
    RunFolder.create(tmp_path / "x", Run(Config(iterations=20, **schedule)))
    arguments = ["--resume", "--name", "x", "--out", str(tmp_path), "--iterations", "30"]
    ((name, value),) = schedule.items()
    with pytest.raises(ValueError, match=f"the run has {name}={value} and iterations=20, not 30"):
        open_run(select(arguments), arguments)
    assert json.loads((tmp_path / "x/config.json").read_text())["config"]["iterations"] == 20
    Run(Config(iterations=30)).check_continues(Run(Config(iterations=20)))


def row_of(seed, iteration, evaluation):
    counts = {"episodes": 8 * iteration, "transitions": 48 * iteration, "seconds": 1.0 * iteration}
    return {"seed": seed, "iteration": iteration, "evaluation": evaluation, **counts}


def test_another_threshold_is_applied_to_what_was_evaluated():
    """Stored under 0.5, which iteration 2 reached; only iteration 4 reaches 0.9."""
    values = Progress.start(Run(Config()))._replace(iteration=3).to_dict()
    assert "solved" not in values
    rows = [row_of(0, n, share) for n, share in ((1, 0.0), (2, 0.5), (3, 0.6), (4, 0.9))]

    def resumed(share, done=3):
        run = Run(Config(iterations=10, stop_when_solved=share))
        return Progress.resumed({**values, "iteration": done}, run, rows), run

    progress, run = resumed(0.9)
    assert progress.solved == (None,)
    assert progress.active.all()
    progress.check(run, np.array([3]))
    progress, run = resumed(0.9, done=4)
    assert progress.solved[0] is not None
    assert progress.solved[0].iteration == 4
    progress.check(run, np.array([4]))
    assert not progress.active.any()


def test_runs_that_went_past_another_threshold_are_refused():
    rows = [row_of(0, n, share) for n, share in ((1, 0.0), (2, 0.5), (3, 0.6))]
    values = Progress.start(Run(Config()))._replace(iteration=3).to_dict()
    lower = Run(Config(iterations=10, stop_when_solved=0.5))
    with pytest.raises(ValueError, match=r"seed 0 would be after iteration 2, but it is after 3"):
        Progress.resumed(values, lower, rows).check(lower, np.array([3]))
    # The second seed stopped at 0.5, and training went on without it.
    rows += [row_of(1, n, share) for n, share in ((1, 0.0), (2, 0.5))]
    higher = Run(Config(iterations=10, stop_when_solved=0.9), seeds=2)
    with pytest.raises(ValueError, match=r"seed 1 would be after iteration 3, but it is after 2"):
        Progress.resumed(values, higher, rows).check(higher, np.array([3, 2]))
    fewer = Run(Config(iterations=2))
    with pytest.raises(ValueError, match="iterations must be at least 3, which are done, got 2"):
        Progress.resumed(values, fewer, rows).check(fewer, np.array([3]))


def test_help_documents_every_setting(capsys):
    with pytest.raises(SystemExit) as exit_info:
        main(["--help"])
    assert exit_info.value.code == 0
    text = " ".join(re.sub("[│╭╰─╮╯]", " ", capsys.readouterr().out).split())
    for field in dataclasses.fields(Config):
        assert f"--{field.name.replace('_', '-')}" in text
    assert "half-width of PPO's interval of probability ratios" in text
    assert f"--preset {'|'.join(PRESETS)}" in text


def test_metrics_lose_nothing_but_what_comes_after_the_checkpoint(tmp_path):
    path = tmp_path / "metrics.csv"

    def row(iteration):
        return {
            "seed": 0,
            "iteration": iteration,
            "episodes": 8 * iteration,
            "transitions": np.float32(0.1) * iteration,
            "loss": np.float32(1 / 3),
            "seconds": 0.5,
            "transitions_per_second": 2.0,
        }

    log = MetricsLog(path)
    for iteration in (1, 2, 3):
        log.append([row(iteration)])
    with path.open("a") as file:
        file.write("0,2,1")  # what a kill in mid-write leaves
    log = MetricsLog(path, last_iteration=2)
    log.append([row(3)])
    assert [entry["iteration"] for entry in log.rows] == [1, 2, 3]
    assert read_metrics(path) == log.rows
    assert np.float32(read_metrics(path)[0]["loss"]) == np.float32(1 / 3)
    assert MetricsLog(path).rows == []


def test_training_goes_on_until_every_seed_is_solved():
    run = Run(Config(iterations=10, stop_when_solved=1.0), seeds=2)
    progress = Progress.start(run).after(run, [row_of(0, 1, 0.0), row_of(1, 1, 0.5)])
    assert progress.active.tolist() == [True, True]
    progress = progress.after(run, [row_of(0, 2, 0.0), row_of(1, 2, 1.0)])
    assert progress.active.tolist() == [True, False]
    assert progress.solved == (None, FirstSolved(2, 16, 96, 2.0))
    assert not progress.after(run, [row_of(0, 3, 1.0)]).active.any()
    assert not progress.after(run, [row_of(0, 10, 0.0)]).active.any()
    never = dataclasses.replace(run, config=Config(iterations=10))
    assert Progress.start(never).after(never, [row_of(1, 2, 1.0)]).active.all()


def test_no_iteration_begins_that_could_take_too_many_steps():
    """Iterations of 48 steps and at most 8 * 50 = 400."""
    config = Config(
        iterations=10, episodes_per_iteration=8, minibatch_size=8, max_transitions=48 * 3 + 400
    )
    assert [is_last(row_of(0, n, 0.0), config) for n in (1, 3, 4, 10)] == [False, False, True, True]
    run = Run(config, seeds=2)
    rows = [row_of(0, 4, 0.0), {**row_of(1, 4, 0.0), "transitions": 100}]
    progress = Progress.start(run)._replace(iteration=4).after(run, rows)
    assert progress.active.tolist() == [False, True]
    progress._replace(iteration=5).check(run, np.array([4, 5]))
    with pytest.raises(ValueError, match=r"max_transitions=544, seed 0 would be after iteration 4"):
        progress._replace(iteration=5).check(run, np.array([5, 5]))
    with pytest.raises(ValueError, match=r"takes up to 400 steps, or be None; got 399"):
        dataclasses.replace(config, max_transitions=399)


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch):
    lowered = jax.jit(lambda x: x + 1).lower(1.0)
    monkeypatch.setattr(compilation, "QUICKLY", {"xla_no_such_option": True})
    with pytest.raises(jax.errors.JaxRuntimeError, match="No such compile option"):
        lowered.compile(compilation.QUICKLY)
    assert compilation.compiled(lowered, Config(compile_quickly=True))(1.0) == 2
    monkeypatch.setattr(compilation, "QUICKLY", {"xla_llvm_disable_expensive_passes": "perhaps"})
    with pytest.raises(jax.errors.JaxRuntimeError):  # any other error is not hidden
        compilation.compiled(lowered, Config(compile_quickly=True))
    assert compilation.compiled(lowered, Config())(1.0) == 2


def test_jaxs_own_settings_of_the_cache_go_first(monkeypatch, tmp_path):
    monkeypatch.setattr(compilation, "default_folder", lambda: tmp_path)
    for chosen, made in (("/theirs", None), (None, str(tmp_path))):
        found = {}
        config = SimpleNamespace(jax_compilation_cache_dir=chosen, update=found.__setitem__)
        monkeypatch.setattr(compilation, "jax", SimpleNamespace(config=config))
        compilation.enable_cache()
        assert found.get("jax_compilation_cache_dir") == made
        assert "jax_enable_compilation_cache" not in found


def test_cache_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compilation.default_folder() == tmp_path / "trap_tube_jax" / "jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert compilation.default_folder() == Path.home() / ".cache" / "trap_tube_jax" / "jax"
