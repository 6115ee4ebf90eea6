"""Records of experiments: how they are kept, summed up, drawn."""

import dataclasses
import inspect
import json
import re
import subprocess

import numpy as np
import pytest

from agents.experiments import figures, records, statistics, tables, training
from agents.experiments.protocol import PROTOCOLS, Protocol
from agents.runs import machine
from agents.runs.folder import Run, RunFolder, write_json
from paths import ROOT


def rows(seed, greedy, iterations=None):
    return [
        {
            "seed": seed,
            "iteration": index + 1,
            "episodes": 1024 * (index + 1),
            "transitions": 1000 * (index + 1),
            "evaluation": greedy[index],
            "success": greedy[index] / 2,
            "greedy_p": float("nan") if index % 2 else greedy[index],
            "greedy_overall": float("nan") if index % 2 else greedy[index],
            "seconds": 2.0 * (index + 1),
        }
        for index in range(len(greedy) if iterations is None else iterations)
    ]


MACHINE = {
    "processor": "any",
    "cores": 2,
    "device": "cpu",
    "devices": 1,
    "jax": "0",
    "commit": "abc",
}


def example_record(tmp_path, greedy, iterations):
    """Runs with these evaluations; in test tasks they take 10 * seed, 20 and 0 steps."""
    entries = []
    for seed, values in enumerate(greedy):
        config = Protocol(iterations=iterations).config("ppo+icm")
        made = Run(config, seed=seed)
        folder = RunFolder.create(tmp_path / f"ppo+icm-seed{seed}", made)
        entries.append(training.AlgorithmRun("ppo+icm", folder, made, rows(seed, values)))
    machines = [MACHINE]
    runs = [
        records.seed_record(
            entry,
            entry.run.seed,
            machines=machines,
            evaluate_every=1,
            steps={"base": [11], "p": [10 * entry.run.seed, 20, 0]},
        )
        for entry in entries
    ]
    config = entries[0].run.config.to_dict()
    about = {"max_steps": 50, "equal_to_base": 25.0, "layout": None, "shortest": [5, 10, -1]}
    return {
        "schema": records.SCHEMA,
        "experiment": "exp2",
        "command": "x",
        "protocol": dataclasses.asdict(Protocol(train_set="pstsy", iterations=iterations)),
        "ranked": ["p"],
        "machines": machines,
        "sets": {"base": {**about, "layout": [0], "shortest": [11]}, "p": about},
        "algorithms": [{"name": "ppo+icm", "config": config, "runs": runs}],
    }


@pytest.fixture
def example(tmp_path):
    return example_record(tmp_path, [[0, 0, 0], [0, 1, 0], [0, 0, 0, 1]], iterations=4)


def test_tables_hold_means_deviations_and_intervals(example):
    (entry,) = example["algorithms"]
    # 2,048 and 4,096 episodes; solved 1, 2 and 2 of 3 tasks, of which one is unsolvable.
    episodes = statistics.Spread.of(statistics.episodes_to_solve(entry))
    assert episodes == pytest.approx((3072, 1448.15, 12.7062 * 1024), abs=0.1)
    p = statistics.by_set(example, entry)["p"]
    half_width = 4.30265 * 19.245 / 3**0.5
    assert p.percent == pytest.approx((500 / 9, 19.245, half_width), abs=1e-3)
    assert p.percent_of_solvable == pytest.approx((250 / 3, 28.868, 71.711), abs=1e-3)
    assert p.optimality is not None
    assert p.optimality.mean == pytest.approx((0.5 + 0.5 + 0.375) / 3)
    assert p.worst == 0.25
    text = tables.markdown(example)
    assert "| {P} | 55.6 ± 19.2 [7.7, 100.0] | 0.0 | 2.0 ± 3.0 |" in text
    assert "| mean of the sets apart from base | 55.6 ± 19.2 [7.7, 100.0] | – | – |" in text
    assert "| base | 1 of 1 |" in text
    seed = tables.seeds_table(example).rows[1]
    assert (*seed[:2], seed[3], *seed[-3:-1]) == ("PPO + ICM", "1", "66.7", "66.7", "1 of 3")
    assert "| {P} | 3 | 83.3 ± 28.9 [11.6, 100.0] | 0.458 ± 0.072 [0.279, 0.638] | 0.250 |" in text
    assert not tables.intervals_table(example), "which the columns hold"
    assert "Unfinished: ppo+icm, seed 0, 3 of 4 iterations." in text
    assert "Unfinished: ppo+icm, seed 1, 3 of 4 iterations." in text
    assert "seed 2" not in text
    example["experiment"] = "exp1"
    row = ("PPO + ICM", "2 / 3", "3,072 ± 1,448 [0, 16,083]")
    assert tables.solved_table(example).rows[0] == row
    assert tables.percent_table(example).rows[1] == ("{P}", "55.6 ± 19.2 [7.7, 100.0]", "25.0")
    assert tables.cost_table(example).rows == (("PPO + ICM", "3", "3–4", "3,333", "0:07"),)


def test_one_seed_has_neither_deviation_nor_interval():
    assert statistics.Spread.of([3.0, None]) == (3.0, None, None)
    assert statistics.Spread.of([None]) is None


def test_records_come_back_as_they_were_written(example, tmp_path):
    path = tmp_path / "new" / "x.json"
    write_json(path, example)
    assert tables.markdown(records.read_record(path)) == tables.markdown(example)
    assert figures.digest(records.read_record(path)) == figures.digest(example)
    assert '"shortest": [5, 10, -1]' in path.read_text()
    write_json(path, {**example, "schema": "trap-tube-jax experiment 0"})
    with pytest.raises(ValueError, match="schema 'trap-tube-jax experiment 0'; allowed: 'trap-"):
        records.read_record(path)
    path.write_text("[]")
    with pytest.raises(ValueError, match="is no record: it has no schema"):
        records.read_record(path)


def test_records_are_of_committed_code(example, monkeypatch):
    def check(commit, own, given=None):
        monkeypatch.setattr(records, "machine", lambda: {"commit": own})
        records.check_clean({**example, "machines": [{**MACHINE, "commit": commit}]}, given)

    check("abc", "def")
    check("abc", None, given="def")
    for commit, own in (("abc-dirty", "def"), ("abc", "def-dirty")):
        with pytest.raises(ValueError, match=r"committed code, this one of .*-dirty; commit the"):
            check(commit, own)
    for commit, own in ((None, "def"), ("abc", None)):
        with pytest.raises(ValueError, match="git does not tell; run in a clone, or give --commit"):
            check(commit, own)


def test_curves_are_thinned_at_the_same_points_for_all_seeds():
    long, short = (rows(0, [0.5] * n) for n in (1000, 333))
    for row in (*long, *short):
        row["greedy_p"] = row["greedy_overall"] = 0.123456 if row["iteration"] % 3 == 0 else np.nan
    found = [records.curves(each, 1000, 3) for each in (long, short)]
    assert found[0]["training"]["iteration"] == list(range(5, 1001, 5))
    assert found[1]["training"]["iteration"] == [*range(5, 333, 5), 333]
    assert found[0]["greedy"]["iteration"] == [*range(6, 1000, 6), 999]
    assert found[0]["greedy"]["greedy_p"][0] == 0.1235
    back = records.rows_of({"seed": 7, "curves": found[0]})
    assert len(back) == len(found[0]["training"]["iteration"]) + len(
        found[0]["greedy"]["iteration"]
    )
    assert {row["seed"] for row in back} == {7}


def test_a_commit_is_dirty_where_code_changed(tmp_path, monkeypatch):
    def git(*arguments):
        given = ["git", "-c", "user.name=x", "-c", "user.email=x@x", *arguments]
        subprocess.run(given, cwd=tmp_path, check=True, capture_output=True)

    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "a.py").write_text("1\n")
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "x")
    monkeypatch.setattr(machine, "ROOT", tmp_path)
    clean = machine.machine()["commit"]
    assert re.fullmatch(r"[0-9a-f]{12}", clean)
    (tmp_path / "record.json").write_text("{}")
    assert machine.machine()["commit"] == clean
    (tmp_path / "agents" / "a.py").write_text("2\n")
    assert machine.machine("given")["commit"] == f"{clean}-dirty"
    # Installed into the repository of somebody else.
    monkeypatch.setattr(machine, "ROOT", tmp_path / "agents")
    assert machine.machine()["commit"] is None
    assert machine.machine("given")["commit"] == "given"


def test_many_algorithms_are_rows(example, tmp_path):
    (entry,) = example["algorithms"]
    names = ("ppo+icm", "ppo+rnd", "ppo+ride")
    example["algorithms"] = [{**entry, "name": name} for name in names]
    table = tables.percent_table(example)
    assert table.heads == ("algorithm", "base", "{P}", tables.MEAN_OF_SETS)
    assert [row[0] for row in table.rows] == [
        *("PPO + ICM", "ppo+rnd", "ppo+ride", "PPO, paper", "PPO + ICM, paper")
    ]
    assert table.rows[1][2:] == ("55.6 ± 19.2", "55.6 ± 19.2")
    assert table.rows[4][2:] == ("2.0 ± 3.0", "–")
    (intervals,) = tables.intervals_table(example)
    assert (intervals.heads, [row[0] for row in intervals.rows]) == (
        table.heads,
        ["PPO + ICM", "ppo+rnd", "ppo+ride"],
    )
    assert intervals.rows[1] == ("ppo+rnd", "[100.0, 100.0]", "[7.7, 100.0]", "[7.7, 100.0]")
    assert "| ppo+rnd | [100.0, 100.0] | [7.7, 100.0] | [7.7, 100.0] |" in (
        tables.markdown(example)
    )
    assert len(tables.seeds_table(example).rows) == 9
    example["algorithms"].append({**entry, "name": "ppo"})
    figures.save(example, tmp_path / "x.png")
    assert figures.drawn_from(tmp_path / "x.png") == figures.digest(example)


def test_curves_are_drawn_of_seeds_of_any_length(example, tmp_path):
    some = [*rows(0, [0.0, 0.5, 1.0]), *rows(1, [0.25])]
    episodes, values = figures.by_episodes(some, "greedy_p")
    assert episodes.tolist() == [1024, 3072]
    np.testing.assert_array_equal(values, [[0, 1], [0.25, np.nan]])
    for experiment in PROTOCOLS:
        example["experiment"] = experiment
        figures.save(example, tmp_path / "x.png")
        assert figures.drawn_from(tmp_path / "x.png") == figures.digest(example)
    assert figures.drawn_from(tmp_path / "none.png") is None


@pytest.mark.parametrize("drawn_by", [figures])
def test_figures_are_out_of_date_where_the_code_that_draws_them_changed(monkeypatch, drawn_by):
    before = drawn_by.digest({})
    assert before == drawn_by.digest({}) != drawn_by.digest({"seed": 1})
    monkeypatch.setattr(inspect, "getsource", lambda code: f"{code.__name__}, changed")
    assert drawn_by.digest({}) != before


def test_training_is_averaged_over_the_last_points_of_its_seed():
    mixed = [*rows(0, [0.0, 1.0] * figures.SMOOTHED), *rows(1, [1.0]), {"seed": 1, "greedy_p": 1.0}]
    first, second, *_, last = (row.get("success") for row in figures.smoothed(mixed)[:20])
    assert (first, second, last) == (0.0, 0.25, 0.25)  # `rows` halves it
    assert [row.get("success") for row in figures.smoothed(mixed)[20:]] == [0.5, None]


def test_recorded_commands_are_those_of_the_protocols_and_machines():
    found = [json.loads(path.read_text()) for path in (ROOT / "benchmarks/results").glob("*.json")]
    experiments = [record for record in found if record["schema"] == records.SCHEMA]
    assert len(experiments) >= 5
    for record in experiments:
        names = [entry["name"] for entry in record["algorithms"]]
        (devices,) = {each["devices"] for each in record["machines"]}
        command = Protocol.from_dict(record["protocol"]).command(
            record["experiment"], names, devices
        )
        assert record["command"] == command


@pytest.mark.parametrize("experiment", PROTOCOLS)
def test_the_papers_numbers_stand_beside_its_own_sets_only(example, experiment):
    example["experiment"] = experiment
    example["protocol"]["train_set"] = PROTOCOLS[experiment].train_set
    assert "PPO + ICM, paper" in tables.markdown(example)
    assert tables.title(example).startswith("Experiment ")
    example["protocol"]["train_set"] = "sy"
    assert ", paper" not in tables.markdown(example)
    assert tables.title(example) == "Train on {Sy}, preset paper"
    assert ("{Sy} solved; " in tables.markdown(example)) == (experiment == "exp1")
