"""Runs from Python: what they write, how they continue, and how they end badly."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import agents
from agents.acting import evaluation
from agents.ppo.learner import Learner
from agents.runs import checkpoint, session
from agents.runs.folder import Run, RunFolder, RunOptions
from agents.runs.loading import read_policy
from agents.runs.metrics import append_rows, read_rows
from agents.runs.results import metrics, results
from agents.runs.session import train_run
from agents.runs.stopping import Stopped
from small_runs import final_state, small_config, untimed
from trap_tube_jax.scoring.tasks import ALL_SETS

ITERATIONS = 6
TRACKED = RunOptions(
    checkpoint_every=2, evaluate_every=2, sets=("base", "p"), reported=3, report=False
)
PLAIN = RunOptions(checkpoint_every=2, sets=("base",), report=False)


def small_run(iterations=ITERATIONS, **values):
    return Run(small_config(iterations=iterations), **values)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing interrupts, evaluated as it goes. Not to be changed."""
    path = tmp_path_factory.mktemp("runs") / "whole"
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


def test_results_are_a_tidy_table(whole):
    table = results(whole.parent)
    assert list(table["task_set"]) == ["base", "p"] * 4
    assert set(table["algorithm"]) == {"ppo+effects"}
    assert set(table["hidden"]) == {4}
    assert set(table["run"]) == {str(whole)}
    assert list(metrics([whole])["iteration"]) == list(range(1, ITERATIONS + 1))
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
    before = (copy / "evaluations.csv").read_bytes()
    assert train_run(copy, small_run(), TRACKED) == []
    assert (copy / "evaluations.csv").read_bytes() == before


def test_the_best_policy_is_never_newer_than_the_last_checkpoint(tmp_path, monkeypatch):
    """Of a run that is killed between two checkpoints."""
    monkeypatch.setattr(session, "append_rows", lambda path, rows: _raise_at(3, path, rows))
    options = dataclasses.replace(TRACKED, evaluate_every=1, checkpoint_every=100)
    with pytest.raises(KeyboardInterrupt):
        train_run(tmp_path / "x", small_run(), options)
    best = read_policy(RunFolder(tmp_path / "x").best).iteration
    assert best <= final_state(tmp_path / "x")[0] <= 2


def _raise_at(iteration, path, rows):
    if rows[0]["iteration"] == iteration:
        raise KeyboardInterrupt
    append_rows(path, rows)


def test_a_finished_run_is_extended(copy):
    train_run(copy, small_run(iterations=ITERATIONS + 1), TRACKED)
    assert final_state(copy)[0] == ITERATIONS + 1
    assert RunFolder(copy).read().config.iterations == ITERATIONS + 1
    tested = read_rows(copy / "evaluations.csv").query("purpose == 'test'")
    assert len(tested) in (2, 4)  # as the best parameters are the old ones or new ones
    with pytest.raises(ValueError, match="iterations must be at least 7, which are done, got 6"):
        train_run(copy, small_run(), TRACKED)


def test_divergence_stops_training_and_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    iterate = Learner.iterate

    def diverge(self, state):
        after, metrics = iterate(self, state)
        return after, {**metrics, "is_finite": (after.iteration < 3).astype(np.float32)}

    monkeypatch.setattr(Learner, "iterate", diverge)
    with pytest.raises(ValueError, match=r"iteration 3: .* try a learning_rate below 0.002"):
        train_run(tmp_path / "x", small_run(), PLAIN)
    assert final_state(tmp_path / "x")[0] == 2


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("discount=0.5", lambda v: v["config"].update(discount=0.5)),
        ("seed=3", lambda v: v.update(seed=3)),
    ],
)
def test_settings_changed_on_disk_are_noticed(copy, name, change):
    path = copy / "config.json"
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match=f"the run has {name}"):
        train_run(copy, small_run(iterations=9), TRACKED)
    values = {name: values[name] for name in values if name not in ("version", "options")}
    with pytest.raises(ValueError, match=rf"checkpoint 6 .* the run has {name.partition('=')[0]}="):
        train_run(copy, Run.from_dict(values), TRACKED)


def test_metrics_deleted_between_stop_and_resume_cost_the_curve_alone(copy):
    (copy / "metrics.csv").unlink()
    train_run(copy, small_run(iterations=ITERATIONS + 1), TRACKED)
    assert [row["iteration"] for row in untimed(copy)] == [str(ITERATIONS + 1)]


def test_a_full_disk_is_an_error_and_the_run_goes_on_later(tmp_path, monkeypatch):
    def full(*args, **kwargs):
        raise OSError("cannot write checkpoint 2: no space")

    monkeypatch.setattr(checkpoint, "save", full)
    with pytest.raises(OSError, match="no space"):
        train_run(tmp_path / "x", small_run(), PLAIN)
    monkeypatch.undo()
    train_run(tmp_path / "x", small_run(), PLAIN)
    assert final_state(tmp_path / "x")[0] == ITERATIONS


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"keep": 0}, "keep must be an integer >= 1, got 0"),
        ({"checkpoint_every": 0}, "checkpoint_every must be an integer >= 1, got 0"),
        ({"evaluate_every": -1}, "evaluate_every must be an integer >= 0, got -1"),
        ({"reported": 10**9}, "reported must be an integer >= 1 and <= 1000000, got 1000000000"),
        ({"sets": ("q",)}, "unknown task set 'q'"),
    ],
)
def test_impossible_options_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        RunOptions(**values)


def test_all_solved_is_a_share_of_one_for_any_number_of_tasks(tmp_path, monkeypatch):
    """Whose float32 mean is 0.99999994."""
    played = evaluation.Evaluation(jnp.ones(41, bool), *jnp.ones((3, 41)))
    monkeypatch.setattr(session, "evaluate", lambda *args: played)
    run = Run(small_config(iterations=3, stop_when_solved=1.0))
    train_run(tmp_path / "x", run, PLAIN)
    assert [row["evaluation"] for row in untimed(tmp_path / "x")] == ["1.0"]


def test_without_evaluation_the_final_policy_is_tested_on_all_sets(tmp_path):
    train_run(tmp_path / "x", small_run(iterations=1), RunOptions(report=False))
    rows = read_rows(tmp_path / "x" / "evaluations.csv")
    assert rows["task_set"].tolist() == list(ALL_SETS)
    assert set(zip(rows["purpose"], rows["iteration"], strict=True)) == {("test", 1)}
    assert not RunFolder(tmp_path / "x").best.exists()
    policy = agents.load(tmp_path / "x")
    agents.save(tmp_path / "mine.safetensors", policy)
    again = agents.load(tmp_path / "mine.safetensors")
    assert (again.name, again.config) == ("mine", policy.config)
    jax.tree.map(np.testing.assert_array_equal, again.params, policy.params)
