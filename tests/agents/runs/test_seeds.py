"""Several seeds that one program trains together."""

import numpy as np
import pandas as pd
import pytest

import agents
from agents.runs import program
from agents.runs.evaluator import Evaluator
from agents.runs.folder import RunFolder
from agents.runs.loading import read_policy
from agents.runs.metrics import read_rows
from agents.runs.run import Run, RunOptions
from agents.runs.session import train_run, train_runs
from helpers.small_runs import final_state, metrics_row, small_config, stored_run, untimed
from helpers.training import PLAIN, TRACKED, count_up, replace_training, small_run
from helpers.trees import assert_same
from trap_tube_jax.interruptions import Stopped
from trap_tube_jax.scoring.scores import Scores

SEEDS = (3, 4)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Folders of two seeds that train alone for three iterations."""
    root = tmp_path_factory.mktemp("alone")
    for seed in SEEDS:
        train_run(root / f"{seed}", small_run(3, seed=seed), TRACKED)
    return root


def assert_same_rows(found, wanted):
    for seed in SEEDS:
        ours, theirs = (pd.DataFrame(untimed(root / f"{seed}")) for root in (found, wanted))
        pd.testing.assert_frame_equal(ours.astype(float), theirs.astype(float), rtol=1e-3)


@pytest.mark.slow
def test_seeds_of_one_program_equal_seeds_alone(alone, tmp_path):
    runs = {tmp_path / f"{seed}": small_run(3, seed=seed) for seed in SEEDS}
    assert all(train_runs(runs, TRACKED).values())
    assert_same_rows(tmp_path, alone)
    for path in runs:
        ours, theirs = (
            read_rows(root / path.name / "evaluations.csv") for root in (tmp_path, alone)
        )
        pd.testing.assert_frame_equal(ours, theirs)
        assert final_state(path)[0] == read_policy(RunFolder(path).best).iteration + 1 == 3


@pytest.mark.slow
def test_seeds_of_one_program_stop_together_and_go_on_from_where_they_stand(alone, tmp_path):
    """The first is one iteration ahead."""
    runs = {tmp_path / f"{seed}": small_run(3, seed=seed) for seed in SEEDS}
    train_run(tmp_path / "3", small_run(1, seed=3), TRACKED)
    outcomes = train_runs(runs, TRACKED, stop=lambda: True)
    assert all(isinstance(outcome, Stopped) for outcome in outcomes.values())
    assert [final_state(path)[0] for path in runs] == [2, 1]
    train_runs(runs, TRACKED)
    assert_same_rows(tmp_path, alone)


def test_a_seed_that_fails_or_is_solved_ends_alone(tmp_path, monkeypatch):
    """Seed 0 cannot be begun, 1 diverges in iteration 2, 2 is solved then, 3 goes on.

    Seed 4 cannot begin to train.
    """
    advance = program.Cohort.advance

    def end(cohort):
        metrics = {name: np.array(values) for name, values in advance(cohort).items()}
        if metrics["episodes"].max() == 2 * 8:
            metrics["loss"][0] = np.nan
            metrics["validation_success"][1] = True
        return metrics

    tested = []
    play = Evaluator.__call__

    def record(evaluator, params):
        tested.append(params)
        return play(evaluator, params)

    replace_training(monkeypatch, count_up)
    monkeypatch.setattr(program.Cohort, "advance", end)
    monkeypatch.setattr(Evaluator, "__call__", record)
    config = small_config(iterations=3, stop_when_solved=1.0)
    runs = {tmp_path / f"{seed}": Run(config, seed) for seed in range(5)}
    stored_run(tmp_path / "0", Run(config), [metrics_row(1)], options=PLAIN)
    (tmp_path / "4").mkdir()
    (tmp_path / "4" / "provenance.json").write_text("{")
    failed, diverged, solved, other, damaged = train_runs(runs, PLAIN).values()
    assert "no checkpoint" in str(failed)
    assert "provenance.json" in str(damaged)
    assert "diverged in iteration 2" in str(diverged)
    assert isinstance(solved, Scores)
    assert isinstance(other, Scores)
    assert [final_state(path)[0] for path in runs if path.name != "0"] == [0, 2, 3, 0]
    (iteration,) = read_rows(tmp_path / "2" / "evaluations.csv")["iteration"]
    assert iteration == 2
    assert_same(tested[0], agents.load(tmp_path / "2").params)


def test_runs_of_one_program_differ_only_in_their_seed(tmp_path):
    runs = {tmp_path / "a": small_run(), tmp_path / "b": small_run(7)}
    with pytest.raises(ValueError, match="differ only in their seed"):
        train_runs(runs)
    runs = {tmp_path / "a": small_run(), tmp_path / "b": small_run(seed=1)}
    with pytest.raises(ValueError, match="use one device"):
        train_runs(runs, RunOptions(devices=2))
