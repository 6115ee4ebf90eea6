"""Runs from Python: what they write, how they continue, and how they end badly."""

import dataclasses
import io
import itertools
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from rich.console import Console

import agents
import trap_tube_jax as tt
from agents.arrays import read_arrays, write_arrays
from agents.runs import history, program, progress, session
from agents.runs.folder import RunFolder
from agents.runs.loading import read_policy
from agents.runs.metrics import append_rows, read_rows
from agents.runs.progress import Progress
from agents.runs.results import metrics, results
from agents.runs.run import Run, RunOptions
from agents.runs.session import train_run, train_runs
from helpers.small_runs import final_state, small_config, untimed
from helpers.training import (
    ITERATIONS,
    PLAIN,
    TRACKED,
    count_up,
    outcome,
    replace_training,
    small_run,
)
from trap_tube_jax.interruptions import Stopped
from trap_tube_jax.scoring import suite
from trap_tube_jax.scoring.tasks import ALL_SETS, evaluation_tasks

pytestmark = pytest.mark.usefixtures("plain_path")

ASKED: list[tuple[str, str]] = []  # sets and purposes of the tasks that `whole` has drawn


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing interrupts, evaluated as it goes. Not to be changed."""
    path = tmp_path_factory.mktemp("runs") / "whole"

    def record(name, number, features, purpose):
        ASKED.append((name, purpose))
        return evaluation_tasks(name, number, features, purpose)

    with pytest.MonkeyPatch.context() as patch:
        for module in (suite, tt):
            patch.setattr(module, "evaluation_tasks", record)
        train_run(path, small_run(), TRACKED)
    return path


@pytest.fixture
def copy(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "copy")


def test_a_run_writes_metrics_and_evaluations(whole):
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
    chosen_by = [
        (name, "validation") for name in ("TrapTube-v0", "PerceptualTrapTube-v0", "TrapTube-v0")
    ]
    assert [*chosen_by, ("TrapTube-v0", "test"), ("PerceptualTrapTube-v0", "test")] == ASKED


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
    """Stopped two iterations and an evaluation after a checkpoint."""
    path = tmp_path / "stopped"
    record = Progress.record

    def stop(self, metrics, seconds):
        record(self, metrics, seconds)
        if self.iteration == 5:
            raise Stopped(2)

    monkeypatch.setattr(Progress, "record", stop)
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


def test_a_run_has_ended_with_its_last_iteration_and_its_test(copy):
    assert history.has_ended(RunFolder(copy), small_run())
    assert not history.has_ended(RunFolder(copy), small_run(iterations=ITERATIONS + 1))
    rows = (copy / "evaluations.csv").read_text()
    (copy / "evaluations.csv").write_text(rows.replace("test", "validation"))
    assert not history.has_ended(RunFolder(copy), small_run())


def test_a_finished_run_returns_at_once(copy, monkeypatch):
    monkeypatch.setattr(program, "make_advance", None)
    before = (copy / "evaluations.csv").read_bytes()
    output = io.StringIO()
    assert train_run(copy, small_run(), TRACKED, console=Console(file=output)) is None
    assert (copy / "evaluations.csv").read_bytes() == before
    assert "to play other tasks, run python -m agents.evaluate" in output.getvalue()


def test_a_stored_run_keeps_its_options_unless_others_are_given(copy):
    before = (copy / "config.json").read_bytes()
    assert train_run(copy, small_run()) is None
    assert (copy / "config.json").read_bytes() == before


def test_the_best_policy_is_never_newer_than_the_last_checkpoint(tmp_path, monkeypatch):
    """Of a run that is killed between two checkpoints."""
    monkeypatch.setattr(progress, "append_rows", lambda path, rows: _raise_at(3, path, rows))
    options = dataclasses.replace(TRACKED, evaluate_every=1, checkpoint_every=100)
    with pytest.raises(KeyboardInterrupt):
        train_run(tmp_path / "x", small_run(), options)
    best = read_policy(RunFolder(tmp_path / "x").best).iteration
    assert best <= final_state(tmp_path / "x")[0] <= 2


def test_a_best_policy_lost_by_a_kill_is_saved_on_resume(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "save", lambda *_: _raise(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train_run(tmp_path / "x", small_run(), TRACKED)
    monkeypatch.undo()
    monkeypatch.setattr(program, "make_advance", lambda *_: _raise(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train_run(tmp_path / "x", small_run(), TRACKED)
    assert read_policy(RunFolder(tmp_path / "x").best).iteration == 2


def _raise_at(iteration, path, rows):
    if rows[0]["iteration"] == iteration:
        raise KeyboardInterrupt
    append_rows(path, rows)


def test_a_finished_run_is_extended(copy, monkeypatch):
    """Its last parameters are made the best, so they are tested; an iteration takes a second."""
    clock = SimpleNamespace(perf_counter=itertools.count().__next__)
    monkeypatch.setattr(session, "time", clock)
    monkeypatch.setattr(progress, "best_iteration", lambda rows, _: rows["iteration"].max())
    rows = [path.read_text() for path in copy.glob("*.csv")]
    train_run(copy, small_run(iterations=ITERATIONS + 1), TRACKED)
    assert final_state(copy)[0] == ITERATIONS + 1
    for path, before in zip(copy.glob("*.csv"), rows, strict=True):
        assert path.read_text().startswith(before)
    assert RunFolder(copy).read()[0].config.iterations == ITERATIONS + 1
    tested = read_rows(copy / "evaluations.csv").query("purpose == 'test'")
    assert tested["iteration"].tolist()[2:] == [ITERATIONS + 1] * 2
    before, after = read_rows(copy / "metrics.csv")["seconds"].iloc[-2:]
    assert after == pytest.approx(before + 1)
    with pytest.raises(ValueError, match="iterations must be at least 7, which are done, got 6"):
        train_run(copy, small_run(), TRACKED)


def test_a_run_that_trains_on_scores_its_old_best_policy_again(copy, monkeypatch):
    """For the report, whose curves have grown; the rows stay as they are."""
    monkeypatch.setattr(progress, "best_iteration", lambda *_: None)
    tested = read_rows(copy / "evaluations.csv").query("purpose == 'test'")
    scores = train_run(copy, small_run(iterations=ITERATIONS + 1), TRACKED)
    assert scores is not None
    assert [score.solved for score in scores.sets] == tested["solved"].tolist()
    again = read_rows(copy / "evaluations.csv").query("purpose == 'test'")
    assert again.reset_index(drop=True).equals(tested.reset_index(drop=True))


def test_a_report_stays_until_there_are_other_scores(copy, monkeypatch):
    RunFolder(copy).page.write_text("earlier")
    monkeypatch.setattr(Progress, "record", lambda *_: _raise(Stopped(2)))
    options = dataclasses.replace(TRACKED, report=True)
    with pytest.raises(Stopped):
        train_run(copy, small_run(iterations=ITERATIONS + 1), options)
    assert RunFolder(copy).page.read_text() == "earlier"


def cut(path):
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))


def remove(path):
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def make_a_file(path):
    remove(path)
    path.touch()


def forget(key):
    """Returns a function that removes one of the plain values of a file of arrays."""

    def damage(path):
        arrays, about = read_arrays(path)
        del about[key]
        write_arrays(path, arrays, about)

    return damage


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("checkpoints", remove, "no checkpoint to continue from; restore"),
        ("checkpoints", make_a_file, "no checkpoint to continue from; restore"),
        ("best.safetensors", remove, "No such file.*best.safetensors"),
        ("best.safetensors", make_a_file, "best.safetensors cannot be read"),
        ("best.safetensors", forget("iteration"), "best.safetensors lacks 'iteration'"),
        (
            "checkpoints/6.safetensors",
            forget("seconds"),
            "cannot be continued: it has no seconds",
        ),
    ],
)
def test_a_run_with_missing_files_is_refused_unchanged(copy, name, damage, message):
    damage(copy / name)
    before = contents(copy)
    with pytest.raises((ValueError, OSError), match=message):
        train_run(copy, small_run(iterations=ITERATIONS + 1), TRACKED)
    assert contents(copy) == before


@pytest.mark.parametrize("changed", [{"sets": ("st",)}, {"evaluate_every": 0}, {"test_tasks": 9}])
def test_a_resumed_run_keeps_its_evaluation(copy, changed):
    before = contents(copy)
    options = dataclasses.replace(TRACKED, **changed)
    with pytest.raises(ValueError, match="max_transitions, stop_when_solved may change"):
        train_run(copy, small_run(iterations=ITERATIONS + 1), options)
    assert contents(copy) == before


def test_evaluations_after_the_newest_checkpoint_are_made_again(copy):
    rows = (copy / "evaluations.csv").read_text()
    remove(copy / "checkpoints" / "6.safetensors")
    train_run(copy, small_run(), TRACKED)
    again = (copy / "evaluations.csv").read_text()
    assert sorted(again.splitlines()) == sorted(rows.splitlines())


def contents(folder):
    return {
        path: path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != ".lock"
    }


def test_a_run_that_is_killed_before_its_first_iteration_begins_again(tmp_path, monkeypatch):
    monkeypatch.setattr(program, "make_advance", lambda *_: _raise(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train_run(tmp_path / "x", small_run(), PLAIN)
    assert final_state(tmp_path / "x")[0] == 0
    monkeypatch.undo()
    train_run(tmp_path / "x", small_run(iterations=1), PLAIN)
    assert len(untimed(tmp_path / "x")) == 1


def test_a_run_on_a_mixture_is_scored_on_it_and_goes_on(tmp_path, monkeypatch):
    replace_training(monkeypatch, count_up)
    for iterations in (1, 2):
        run = Run(small_config(iterations=iterations, env_id="base+{P}"))
        train_run(tmp_path / "x", run, RunOptions(sets=("base+p",), test_tasks=3, report=False))
    assert len(untimed(tmp_path / "x")) == 2
    assert set(results(tmp_path)["task_set"]) == {"base+p"}
    assert agents.load(tmp_path / "x").config.env_id == "TrapTube-v0+PerceptualTrapTube-v0"


@pytest.mark.parametrize(
    ("train_set", "earlier", "later", "best"),
    [
        ("p", {"base": 0, "p": 0.25, "st": 0.25}, {"base": 0, "p": 0.5, "st": 0.2}, 2),
        ("p", {"base": 0, "p": 0.25}, {"base": 1, "p": 0.25}, 1),
        ("base", {"base": 0, "p": 0.25}, {"base": 1, "p": 0.25}, 2),
        ("p", {"base": 0}, {"base": 1}, 2),
        ("p", {"p": 0.25}, {"p": 0.25}, 1),
        ("p", {}, {}, None),
    ],
)
def test_the_best_policy_has_the_highest_mean_over_the_sets(train_set, earlier, later, best):
    """Sets count the same whatever their size; base only where it is trained on, or alone."""
    tasks = {"base": 1, "p": 4, "st": 100}
    rows = [
        (i, purpose, name, tasks[name], share * tasks[name])
        for i, shares in enumerate((earlier, later), 1)
        for name, share in shares.items()
        for purpose, share in (("validation", share), ("test", 1 - share))
    ]
    columns = ["iteration", "purpose", "task_set", "tasks", "solved"]
    assert history.best_iteration(pd.DataFrame(rows, columns=columns), train_set) == best


def test_divergence_stops_training_and_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    def diverge(after, metrics):
        return after, {**metrics, "loss": 1 / (after.iteration < 3)}

    replace_training(monkeypatch, diverge)
    with pytest.raises(ValueError, match=r"iteration 3: .* try a learning_rate below 0.002"):
        train_run(tmp_path / "x", small_run(), PLAIN)
    assert final_state(tmp_path / "x")[0] == 2


def test_a_reward_that_is_not_finite_names_its_curiosity(tmp_path, monkeypatch):
    def diverge(after, metrics):
        return after, {**metrics, "intrinsic_reward": jnp.float32(np.nan)}

    replace_training(monkeypatch, diverge)
    message = "'effects' returned a reward that is not finite in iteration 1"
    with jax.debug_nans(False), pytest.raises(ValueError, match=message):
        train_run(tmp_path / "x", small_run(), PLAIN)


def test_a_run_stops_after_the_iteration_in_which_it_is_asked_to(tmp_path, monkeypatch):
    replace_training(monkeypatch, lambda *returned: returned)
    with pytest.raises(Stopped):
        train_run(tmp_path / "x", small_run(), PLAIN, stop=lambda: True)
    assert final_state(tmp_path / "x")[0] == len(untimed(tmp_path / "x")) == 1


def test_speed_is_steps_over_the_seconds_of_an_iteration(tmp_path, monkeypatch):
    """By a clock on which every iteration takes two seconds; seeds of a program share them."""
    clock = itertools.count(0, 2)
    monkeypatch.setattr(session, "time", SimpleNamespace(perf_counter=clock.__next__))

    def play(state, metrics):
        return state._replace(transitions=state.transitions + 30), metrics

    replace_training(monkeypatch, play)
    train_run(tmp_path / "x", small_run(iterations=2), PLAIN)
    rows = read_rows(tmp_path / "x" / "metrics.csv")
    assert rows["transitions_per_second"].tolist() == [15, 15]
    assert rows["seconds"].tolist() == [2, 4]
    train_runs({tmp_path / str(seed): small_run(seed=seed, iterations=2) for seed in (0, 1)}, PLAIN)
    for seed in (0, 1):
        assert read_rows(tmp_path / str(seed) / "metrics.csv")["seconds"].tolist() == [1, 2]


def test_all_solved_is_a_share_of_one_for_any_number_of_tasks(tmp_path, monkeypatch):
    """Whose float32 mean is 0.99999994."""
    solved = outcome(jnp.full(41, True))
    replace_training(monkeypatch, lambda *returned: returned, lambda *_: solved)
    run = Run(small_config(iterations=3, stop_when_solved=1.0))
    train_run(tmp_path / "x", run, PLAIN)
    assert [row["validation_success"] for row in untimed(tmp_path / "x")] == ["1.0"]


def test_validation_success_is_of_the_policy_after_the_iteration(tmp_path, monkeypatch):
    """The value's bias counts iterations; tasks are solved where it is 2."""

    def play(agent, params, *_):
        return outcome(params["heads"]["params"]["value"]["bias"][:1] == 2)

    replace_training(monkeypatch, count_up, play)
    train_run(tmp_path / "x", small_run(iterations=2), PLAIN)
    assert [row["validation_success"] for row in untimed(tmp_path / "x")] == ["0.0", "1.0"]


def test_success_is_measured_within_the_limit_of_the_task_set(tmp_path, monkeypatch):
    """Of 50 steps, whatever the limit of training."""

    def play(agent, params, env, *_):
        return outcome(jnp.array([env.max_steps == 50]))

    replace_training(monkeypatch, lambda *returned: returned, play)
    train_run(tmp_path / "x", small_run(iterations=1), PLAIN)
    assert [row["validation_success"] for row in untimed(tmp_path / "x")] == ["1.0"]


def test_without_evaluation_the_final_policy_is_tested_on_all_sets(tmp_path):
    train_run(tmp_path / "x", small_run(iterations=1), RunOptions(report=False))
    rows = read_rows(tmp_path / "x" / "evaluations.csv")
    assert rows["task_set"].tolist() == list(ALL_SETS)
    assert set(zip(rows["purpose"], rows["iteration"], strict=True)) == {("test", 1)}
    assert not RunFolder(tmp_path / "x").best.exists()
