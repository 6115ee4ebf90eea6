"""Runs from Python: what they write, how they continue, and how they end badly."""

import dataclasses
import functools
import io
import itertools
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pandas as pd
import pytest
from rich.console import Console

import agents
from agents.acting import evaluation
from agents.ppo.learner import Learner
from agents.runs import checkpoint, session
from agents.runs.folder import RunFolder
from agents.runs.loading import read_policy
from agents.runs.metrics import append_rows, read_rows
from agents.runs.results import metrics, results
from agents.runs.run import Run, RunOptions
from agents.runs.session import train_run
from agents.runs.stopping import Stopped
from small_runs import final_state, small_config, untimed
from trap_tube_jax.scoring.tasks import ALL_SETS, evaluation_tasks

ITERATIONS = 6
TRACKED = RunOptions(
    checkpoint_every=2, evaluate_every=2, sets=("base", "p"), test_tasks=3, report=False
)
PLAIN = RunOptions(checkpoint_every=2, sets=("base",), report=False)
ASKED: list[tuple[str, str]] = []  # sets and purposes of the tasks that `whole` has drawn


def small_run(iterations=ITERATIONS, **values):
    replay = {"replay_fractions": (0.25, 0.25), "replay_capacity": 5}
    return Run(small_config(iterations=iterations, motion_coef=0.5, **replay), **values)


def replace_training(monkeypatch, change):
    """Makes an iteration count and set its metrics to 0, then `change` what it returns."""
    iterate = Learner.iterate

    def count(self, state):
        _, metrics = jax.eval_shape(functools.partial(iterate, self), state)
        metrics = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metrics)
        return change(state._replace(iteration=state.iteration + 1), metrics)

    monkeypatch.setattr(Learner, "iterate", count)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing interrupts, evaluated as it goes. Not to be changed."""
    path = tmp_path_factory.mktemp("runs") / "whole"

    def record(name, number, features, purpose):
        ASKED.append((name, purpose))
        return evaluation_tasks(name, number, features, purpose)

    with pytest.MonkeyPatch.context() as patch:
        for module in (evaluation, session):
            patch.setattr(module, "evaluation_tasks", record)
        train_run(path, small_run(), TRACKED)
    return path


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def test_a_run_leaves_its_rows(whole):
    rows = untimed(whole)
    assert [row["iteration"] for row in rows] == [str(n + 1) for n in range(ITERATIONS)]
    assert [row["episodes"] for row in rows] == [str(8 * n + 8) for n in range(ITERATIONS)]
    found = [
        (row.iteration, row.purpose, row.task_set, row.tasks)
        for row in read_rows(whole / "evaluations.csv").itertuples()
    ]
    validation = [
        (n, "validation", name, tasks) for n in (2, 4, 6) for name, tasks in (("base", 1), ("p", 2))
    ]
    best = read_policy(RunFolder(whole).best).iteration
    assert found == [*validation, (best, "test", "base", 1), (best, "test", "p", 3)]
    assert agents.load(whole).iteration == best


def test_only_the_final_evaluation_plays_test_tasks(whole):
    chosen_by = [(name, "validation") for name in ("base", "p", "TrapTube-v0")]
    assert [*chosen_by, ("base", "test"), ("p", "test")] == ASKED


def test_results_are_a_tidy_table(whole, tmp_path):
    table = results(whole.parent)
    assert list(table["task_set"]) == ["base", "p"] * 4
    assert set(table["algorithm"]) == {"ppo+effects"}
    assert set(table["hidden"]) == {4}
    assert set(table["run"]) == {str(whole)}
    assert list(metrics([whole])["iteration"]) == list(range(1, ITERATIONS + 1))
    (tmp_path / "link").symlink_to(whole)
    assert len(results(tmp_path)) == len(table)
    with pytest.raises(ValueError, match="holds no run"):
        results(whole / "checkpoints")


def test_stopped_runs_continue_to_the_same_bits(whole, tmp_path, monkeypatch):
    """Stopped between two checkpoints; the rows and the best parameters are the same, too."""
    path, advance = tmp_path / "stopped", session.Session._iterate

    def stop(self, program):
        row = advance(self, program)
        return row if self.iteration != 3 else _raise(Stopped(2))

    monkeypatch.setattr(session.Session, "_iterate", stop)
    with pytest.raises(Stopped):  # as a kill would: the iteration is not saved
        train_run(path, small_run(), TRACKED)
    monkeypatch.undo()
    train_run(path, small_run(), TRACKED)
    assert final_state(path) == final_state(whole)
    assert untimed(path) == untimed(whole)
    names = ("config.json", "evaluations.csv", "best.safetensors")
    for name in names:
        assert (path / name).read_bytes() == (whole / name).read_bytes()


def _raise(error):
    raise error


def test_a_finished_run_returns_at_once(copy, monkeypatch):
    monkeypatch.setattr(session, "make_advance", None)
    before, output = (copy / "evaluations.csv").read_bytes(), io.StringIO()
    more = dataclasses.replace(TRACKED, test_tasks=9)
    assert train_run(copy, small_run(), more, console=Console(file=output)) is None
    assert (copy / "evaluations.csv").read_bytes() == before
    assert "agents.evaluate plays other" in output.getvalue()


def test_the_best_policy_is_never_newer_than_the_last_checkpoint(tmp_path, monkeypatch):
    """Of a run that is killed between two checkpoints."""
    monkeypatch.setattr(session, "append_rows", lambda path, rows: _raise_at(3, path, rows))
    options = dataclasses.replace(TRACKED, evaluate_every=1, checkpoint_every=100)
    with pytest.raises(KeyboardInterrupt):
        train_run(tmp_path / "x", small_run(), options)
    best = read_policy(RunFolder(tmp_path / "x").best).iteration
    assert best <= final_state(tmp_path / "x")[0] <= 2


def test_a_kill_before_the_best_policy_is_saved_is_made_good(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(session, "save", lambda *_: _raise(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train_run(tmp_path / "x", small_run(), TRACKED)
    monkeypatch.undo()
    train_run(tmp_path / "x", small_run(iterations=2), dataclasses.replace(TRACKED, sets=("base",)))
    assert read_policy(RunFolder(tmp_path / "x").best).iteration == 2


def _raise_at(iteration, path, rows):
    if rows[0]["iteration"] == iteration:
        raise KeyboardInterrupt
    append_rows(path, rows)


def test_a_run_that_goes_on_without_selection_reports_its_last_policy(copy):
    options = dataclasses.replace(TRACKED, evaluate_every=0)
    train_run(copy, small_run(iterations=ITERATIONS + 1), options)
    tested = read_rows(copy / "evaluations.csv").query("purpose == 'test'")
    assert tested["iteration"].tolist()[2:] == [ITERATIONS + 1] * 2
    assert agents.load(copy).iteration == ITERATIONS + 1


def test_a_finished_run_is_extended(copy, monkeypatch):
    """Its last parameters are made the best, so they are tested; an iteration takes a second."""
    clock = SimpleNamespace(perf_counter=itertools.count().__next__)
    monkeypatch.setattr(session, "time", clock)
    monkeypatch.setattr(session, "best_iteration", lambda rows, own: ITERATIONS + 1)
    train_run(copy, small_run(iterations=ITERATIONS + 1), TRACKED)
    assert final_state(copy)[0] == ITERATIONS + 1
    assert RunFolder(copy).read()[0].config.iterations == ITERATIONS + 1
    tested = read_rows(copy / "evaluations.csv").query("purpose == 'test'")
    assert tested["iteration"].tolist()[2:] == [ITERATIONS + 1] * 2
    before, after = read_rows(copy / "metrics.csv")["seconds"].iloc[-2:]
    assert after == pytest.approx(before + 1)
    with pytest.raises(ValueError, match="iterations must be at least 7, which are done, got 6"):
        train_run(copy, small_run(), TRACKED)


def cut(path):
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))


def remove(path):
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def make_a_file(path):
    remove(path)
    path.touch()


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("checkpoints", remove, "no checkpoint to continue from; restore"),
        ("checkpoints", make_a_file, "no checkpoint to continue from; restore"),
        ("metrics.csv", remove, "metrics.csv ends before the checkpoint of iteration 6"),
        ("metrics.csv", cut, "metrics.csv ends before the checkpoint of iteration 6"),
    ],
)
@pytest.mark.parametrize("more", [0, 1])
def test_a_run_with_missing_files_is_refused_unchanged(copy, name, damage, message, more):
    """Resumed as it is, and extended."""
    damage(copy / name)
    before = contents(copy)
    with pytest.raises(ValueError, match=message):
        train_run(copy, small_run(iterations=ITERATIONS + more), TRACKED)
    assert contents(copy) == before


def contents(folder):
    return {
        path: path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != ".lock"
    }


def test_a_run_that_is_killed_before_its_first_iteration_begins_again(tmp_path, monkeypatch):
    monkeypatch.setattr(session, "make_advance", lambda *_: _raise(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train_run(tmp_path / "x", small_run(), PLAIN)
    assert final_state(tmp_path / "x")[0] == 0
    monkeypatch.undo()
    train_run(tmp_path / "x", small_run(iterations=1), PLAIN)
    assert len(untimed(tmp_path / "x")) == 1


def test_a_path_may_begin_at_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    train_run("~/x", small_run(iterations=1), PLAIN)
    assert len(untimed(tmp_path / "x")) == 1


@pytest.mark.parametrize(
    ("own", "sets", "best"),
    [("p", ("base", "p", "st"), 2), ("base", ("base", "p", "st"), 1), ("p", ("base",), 1)],
)
def test_the_best_iteration_is_the_first_of_the_highest_mean_over_sets(own, sets, best):
    """Sets count the same whatever their size; base only where it is trained on; tests never."""
    solved = {1: (1, 1, 50), 2: (0, 4, 0), 3: (0, 2, 50)}
    rows = [
        {"iteration": i, "purpose": "validation", "task_set": name, "tasks": tasks, "solved": count}
        for i, counts in solved.items()
        for name, tasks, count in zip(("base", "p", "st"), (1, 4, 100), counts, strict=True)
    ]
    tested = [{**x, "iteration": 4, "purpose": "test", "solved": x["tasks"]} for x in rows[:3]]
    found = pd.DataFrame(rows + tested)
    assert session.best_iteration(found[found["task_set"].isin(sets)], own) == best


def test_divergence_stops_training_and_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    def diverge(after, metrics):
        return after, {**metrics, "loss": 1 / (after.iteration < 3)}

    replace_training(monkeypatch, diverge)
    with pytest.raises(ValueError, match=r"iteration 3: .* try a learning_rate below 0.002"):
        train_run(tmp_path / "x", small_run(), PLAIN)
    assert final_state(tmp_path / "x")[0] == 2


def test_a_full_disk_is_an_error_and_the_run_goes_on_later(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError("cannot write checkpoint 2: no space")

    monkeypatch.setattr(checkpoint, "save", full)
    with pytest.raises(OSError, match="no space"):
        train_run(tmp_path / "x", small_run(), PLAIN)
    monkeypatch.undo()
    train_run(tmp_path / "x", small_run(), PLAIN)
    assert final_state(tmp_path / "x")[0] == ITERATIONS


def test_all_solved_is_a_share_of_one_for_any_number_of_tasks(tmp_path, monkeypatch):
    """Whose float32 mean is 0.99999994."""
    solved = evaluation.Evaluation(jnp.full(41, True), *jnp.ones((3, 41)))
    monkeypatch.setattr(session, "evaluate", lambda *_: solved)
    replace_training(monkeypatch, lambda *returned: returned)
    run = Run(small_config(iterations=3, stop_when_solved=1.0))
    train_run(tmp_path / "x", run, PLAIN)
    assert [row["validation_success"] for row in untimed(tmp_path / "x")] == ["1.0"]


def test_without_evaluation_the_final_policy_is_tested_on_all_sets(tmp_path):
    train_run(tmp_path / "x", small_run(iterations=1), RunOptions(report=False))
    rows = read_rows(tmp_path / "x" / "evaluations.csv")
    assert rows["task_set"].tolist() == list(ALL_SETS)
    assert set(zip(rows["purpose"], rows["iteration"], strict=True)) == {("test", 1)}
    assert not RunFolder(tmp_path / "x").best.exists()
