"""Command lines of training and evaluation: as processes, stopped, resumed, and refused."""

import csv
import dataclasses
import shutil
import signal
from concurrent import futures

import pytest

import agents
from agents import command_line, evaluate
from agents.config import PRESETS, Config
from agents.files import read_json
from agents.runs import program
from agents.runs.folder import RunFolder
from agents.runs.loading import save
from agents.runs.metrics import append_rows
from agents.runs.provenance import commit
from agents.runs.run import Run, RunOptions
from agents.train import Options, configure, main, run_path, summary
from helpers.refusal import refused
from helpers.small_runs import (
    final_state,
    metrics_row,
    options,
    read_iterations,
    run,
    small_config,
    start,
    untimed,
)
from helpers.tiny_policy import random_policy
from trap_tube_jax import interruptions

ITERATIONS = 30
LENGTH = ["--iterations", ITERATIONS, "--sets", "base", "p"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder and the output of a run that nothing interrupts."""
    out = tmp_path_factory.mktemp("runs")
    arguments = [*options(), *LENGTH, "--name", "whole", "--out", out]
    return out / "whole", run("agents.train", *arguments)


def test_a_run_leaves_its_results_and_says_where(whole):
    folder, output = whole
    names = ("config.json", "metrics.csv", "evaluations.csv", "curves.png", "report.html")
    for name in (*names, "checkpoints", "provenance.json"):
        assert (folder / name).exists(), name
    assert str(folder / "report.html") in output
    assert output.count("iteration ") == ITERATIONS
    assert f"--resume {folder} --iterations {2 * ITERATIONS}" in output
    (machine,) = read_json(folder / "provenance.json")
    assert machine["commit"] == commit()


@pytest.mark.slow
def test_killed_runs_continue_to_the_same_bits(whole, tmp_path):
    """Killed at a moment that differs every time; it can be evaluated before it goes on."""
    path = tmp_path / "killed"
    arguments = ["--name", "killed", "--out", tmp_path, "--checkpoint-every", 1, "--no-report"]
    process = start("agents.train", *options(), *LENGTH, *arguments)
    read_iterations(process, 3)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert 2 <= final_state(path)[0] < ITERATIONS, "killed in training"
    assert f"{path}, iteration" in run("agents.evaluate", path, "--sets", "base")
    run("agents.train", "--resume", path, "--checkpoint-every", 1)
    assert final_state(path) == final_state(whole[0])
    assert untimed(path) == untimed(whole[0])
    assert RunFolder(path).read()[0] == RunFolder(whole[0]).read()[0]
    assert (path / "evaluations.csv").read_text() == (whole[0] / "evaluations.csv").read_text()


def test_ctrl_c_saves_and_says_how_to_continue(tmp_path):
    path = tmp_path / "stopped"
    arguments = ["--iterations", 100_000, "--checkpoint-every", 100_000, "--out", tmp_path]
    process = start("agents.train", *options(), *arguments, "--name", "stopped")
    read_iterations(process, 3)
    second = start("agents.train", "--resume", path)
    _, errors = second.communicate()
    assert second.returncode == 2
    assert f"{path} is being written by another process" in errors
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    hint = f"Stopped. Continue with: python -m agents.train --resume {path}"
    assert (process.returncode, errors) == (130, f"{interruptions.FINISHING}\n{hint}\n")
    assert final_state(path)[0] == len(untimed(path)) >= 3


@pytest.mark.slow
def test_a_run_in_training_is_read_at_any_moment(tmp_path):
    arguments = ["--iterations", 100_000, "--checkpoint-every", 1, "--out", tmp_path]
    process = start("agents.train", *options(), *arguments, "--name", "x")
    read_iterations(process, 2)
    seen = set()
    for _ in range(500):
        seen.add(agents.load(tmp_path / "x").iteration)
        agents.results(tmp_path)
    assert process.poll() is None
    assert len(seen) > 1
    process.kill()
    process.communicate()


@pytest.mark.parametrize(
    ("vanishes", "code", "says"),
    [
        ("pipe", 128 + signal.SIGPIPE, "Stopped. Continue with: "),
        ("folder", 1, "error: "),
    ],
)
def test_training_ends_without_a_traceback_where(vanishes, code, says, tmp_path):
    arguments = ["--iterations", 100_000, "--out", tmp_path, "--name", "x"]
    with start("agents.train", *options(), *arguments) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        read_iterations(process, 1)
        if vanishes == "pipe":
            process.stdout.close()
        else:
            (tmp_path / "x").rename(tmp_path / "gone")
        errors = process.stderr.read()
    assert process.returncode == code
    assert "Traceback" not in errors
    assert says in errors


@pytest.mark.slow
def test_training_runs_in_a_thread(tmp_path):
    arguments = [*options(), "--iterations", "1", "--out", str(tmp_path), "--name", "x"]
    with futures.ThreadPoolExecutor(1) as pool:
        pool.submit(main, arguments).result()
    assert final_state(tmp_path / "x")[0] == 1


def test_evaluate_writes_before_it_prints(whole, tmp_path):
    """Also on a terminal that shows ASCII alone."""
    arguments = [whole[0], "--sets", "base", "StructuralTrapTube-v0", "--tasks", 3, "--optimality"]
    arguments += ["--purpose", "confirmation"]
    files = ["--output", tmp_path / "new/x.csv", "--gif", tmp_path / "new/x.gif"]
    output = run("agents.evaluate", *arguments, *files, PYTHONIOENCODING="ascii")
    with (tmp_path / "new/x.csv").open() as file:
        rows = list(csv.DictReader(file))
    columns = ("policy", "iteration", "purpose", "task_set", "tasks")
    found = [tuple(row[name] for name in columns) for row in rows]
    start = (str(whole[0]), "30", "confirmation")
    assert found == [(*start, "base", "1"), (*start, "st", "3")]
    assert "{St}" in output
    assert str(tmp_path / "new/x.csv") in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--env q", "as by --import MODULE"),
        ("--max-transitions 5", "must allow an iteration, which takes up to 12,800"),
        ("--name a/b", "name must be a folder's name without a path"),
    ],
)
def test_impossible_settings_are_refused_and_write_no_run(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, main, *arguments.split(), "--out", tmp_path)
    assert not list(tmp_path.rglob("*.json"))


def test_a_folder_of_other_files_is_not_written_to(capsys, tmp_path):
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "metrics.csv").write_text("mine")
    assert "exists, but holds no run" in refused(capsys, main, "--out", tmp_path, "--name", "x")
    assert (tmp_path / "x" / "metrics.csv").read_text() == "mine"
    killed = tmp_path / "killed"
    killed.mkdir()
    for name in (".lock", ".config.json.4242"):
        (killed / name).touch()
    RunFolder(killed).check_free()


def test_a_run_is_not_overwritten(capsys, whole):
    folder, _ = whole
    message = refused(capsys, main, "--out", folder.parent, "--name", "whole")
    assert f"holds a run; continue it with --resume {folder}" in message
    for option, problem in (("--hidden 8", "hidden=4, not 8"), ("--seed 1", "seed=0, not 1")):
        message = refused(capsys, main, "--resume", folder, *option.split())
        assert f"{folder} has {problem}" in message
    message = refused(capsys, main, "--resume", folder, "--env", "sy")
    assert "env_id=TrapTube-v0, not SymbolicTrapTube-v0" in message


def test_a_run_is_continued_from_within_its_folder(whole, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(shutil.copytree(whole[0], tmp_path / "x"))
    (tmp_path / "x" / "report.html").unlink()  # it is made again
    main(["--resume", ".", "--report"])
    assert "--resume . --iterations" in capsys.readouterr().out
    assert "<title>x" in (tmp_path / "x" / "report.html").read_text()


def test_a_checkpoint_of_another_run_is_refused(capsys, whole, tmp_path):
    folder = RunFolder(tmp_path / "foreign")
    folder.write_config(Run(Config()))
    shutil.copytree(whole[0] / "checkpoints", folder.checkpoints)
    settings = folder.config.read_bytes()
    assert "cannot be continued" in refused(capsys, main, "--resume", folder.path)
    assert "does not fit" in refused(capsys, evaluate.main, folder.path)
    assert folder.config.read_bytes() == settings


def test_a_stop_before_the_first_file_promises_nothing(capfd, monkeypatch, tmp_path):
    def stop(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(program, "make_learner", stop)
    with pytest.raises(SystemExit) as exit_info:
        main(["--out", str(tmp_path), "--name", "x"])
    assert exit_info.value.code == 130
    assert capfd.readouterr().err == f"Stopped. {tmp_path / 'x'} holds no run to continue.\n"


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ("--output", "evaluations.csv"),
        ("--output", "metrics.csv"),
        ("--output", "checkpoints/1.csv"),
        ("--gif", "best.safetensors"),
    ],
)
def test_an_evaluation_replaces_no_file_of_a_run(option, name, capsys, whole):
    message = refused(capsys, evaluate.main, whole[0], option, whole[0] / name)
    assert f"{name} is a file of the run {whole[0]}; give another path" in message


def test_an_evaluation_replaces_no_file_of_a_grid(capsys, tmp_path):
    for name in ("grid.json", "results.csv"):
        (tmp_path / name).touch()
    path = tmp_path / "results.csv"
    message = refused(capsys, evaluate.main, "best-pstsy", "--output", path)
    assert f"{path} may be a file of a grid; give another path" in message


@pytest.mark.parametrize("option", ["--output", "--gif"])
def test_an_evaluation_refuses_to_write_to_a_folder_before_it_plays(option, capsys, tmp_path):
    message = refused(capsys, evaluate.main, "best-pstsy", option, tmp_path)
    assert f"{tmp_path} is a folder; give the path of a file" in message
    (tmp_path / "x").touch()
    message = refused(capsys, evaluate.main, "best-pstsy", option, tmp_path / "x" / "y" / "z.csv")
    assert f"{tmp_path / 'x'} is not a folder" in message


def test_an_unknown_training_set_is_refused_before_anything_is_played(capsys, tmp_path):
    save(tmp_path / "x.safetensors", random_policy(env_id="Own-v0"))
    arguments = [tmp_path / "x.safetensors", "--sets", "base", "--output", tmp_path / "x.csv"]
    message = refused(capsys, evaluate.main, *arguments, "--gif", tmp_path / "x.gif")
    assert "unknown task set 'Own-v0'" in message
    assert not (tmp_path / "x.csv").exists()


def read(arguments):
    values = command_line.read([Options, Config(), RunOptions()], arguments.split(), "")
    found = command_line.build(Options, values)
    return found, *configure(found, values)


@pytest.mark.parametrize("preset", PRESETS)
def test_options_take_precedence_over_every_preset(preset):
    arguments = f"--preset {preset} --env psy --seed 3 --hidden 32 --curiosity none"
    found, wanted, *_ = read(arguments)
    own = {"env_id": "PerceptualSymbolicTrapTube-v0", "hidden": 32, "curiosity": "none"}
    assert wanted == Run(Config.preset(preset, **own), 3)
    assert run_path(found, wanted).name == f"{preset}-psy-3"
    assert str(run_path(*read("")[:2])) == "runs/fast-base-0"


def test_an_agent_to_fine_tune_has_the_initial_settings(tmp_path, capsys):
    policy = random_policy(env_id="p", hidden=7)
    save(tmp_path / "old.safetensors", policy)
    arguments = f"--finetune {tmp_path / 'old.safetensors'} --env sy --discount 0.9"
    found, wanted, _ = read(arguments)
    config = dataclasses.replace(policy.config, env_id="SymbolicTrapTube-v0", discount=0.9)
    assert wanted == Run(config, finetune=tmp_path / "old.safetensors")
    assert str(run_path(found, wanted)) == "runs/old-sy-0"
    folder = RunFolder(tmp_path / "x")
    folder.write_config(Run(Config()), RunOptions())
    of_a_run = dataclasses.replace(wanted, finetune=folder.best)
    assert str(run_path(found, of_a_run)) == "runs/x-sy-0"
    for preset in PRESETS:
        message = refused(capsys, main, *arguments.split(), "--preset", preset)
        assert "leave out --preset" in message
    message = refused(capsys, main, "--resume", tmp_path, *arguments.split())
    assert "leave out --name, --out, --preset and --finetune" in message


def test_resumed_runs_keep_their_settings_and_options(tmp_path):
    stored = Run(Config.preset("paper", hidden=32), 5, "mine", ("json",))
    how = RunOptions(test_tasks=7, sets=("p", "st"))
    RunFolder(tmp_path / "x").write_config(stored, how)
    arguments = f"--resume {tmp_path / 'x'}"
    found, *wanted = read(arguments)
    assert wanted == [stored, how]
    assert run_path(found, stored) == tmp_path / "x"
    _, *wanted = read(f"{arguments} --iterations 999 --checkpoint-every 2")
    expected = dataclasses.replace(stored.config, iterations=999)
    run = dataclasses.replace(stored, config=expected)
    assert wanted == [run, dataclasses.replace(how, checkpoint_every=2)]


@pytest.mark.parametrize(
    ("settings", "episodes", "expected"),
    [
        ({"stop_when_solved": 1.0}, 4321, "--preset best"),
        ({"stop_when_solved": 1.0}, None, "--iterations 14"),
        ({"stop_when_solved": 0.0, "lr_decay_fraction": 0.5}, None, "report.html"),
        ({"stop_when_solved": 0.0, "max_transitions": 100}, None, "report.html"),
    ],
)
def test_a_run_ends_with_facts_and_what_to_do_next(settings, episodes, expected, tmp_path):
    run = Run(small_config(iterations=7, **settings))
    folder = RunFolder(tmp_path)
    solved = [metrics_row(2, validation_success=1.0, episodes=episodes)] if episodes else []
    rows = (
        [metrics_row(1), *solved, metrics_row(3, validation_success=1.0, episodes=9999)]
        if solved
        else [metrics_row(1)]
    )
    append_rows(folder.metrics, rows)
    assert "report.html" not in "".join(summary(folder, run)), "with --no-report"
    folder.page.touch()
    lines = summary(folder, run)
    assert lines[-1].endswith(expected)
    solved = "First solved base after 4,321 episodes; --stop-when-solved 0 trains on."
    assert (solved in lines) == bool(episodes)


def test_a_limit_that_ended_a_run_is_named(tmp_path):
    run = Run(small_config(max_transitions=40))
    folder = RunFolder(tmp_path)
    append_rows(folder.metrics, [metrics_row(1), metrics_row(2, transitions=48)])
    stopped = "Stopped by --max-transitions 40 after 2 of"
    assert summary(folder, run)[0].startswith(stopped)


def test_the_share_of_solved_tasks_that_ends_a_run_is_named(tmp_path):
    run = Run(small_config(stop_when_solved=0.995))
    folder = RunFolder(tmp_path)
    append_rows(folder.metrics, [metrics_row(1, validation_success=0.996)])
    solved = "First solved 99.5 % of base after 8 episodes; --stop-when-solved 0 trains on."
    assert summary(folder, run)[0] == solved
