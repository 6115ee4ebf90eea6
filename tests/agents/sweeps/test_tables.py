"""Tables and figures are functions of tidy rows, and say what the published records say."""

import dataclasses
import shutil

import numpy as np
import pandas as pd
import pytest
from PIL import Image

import trap_tube_jax as tt
from agents.files import read_json, write_json
from agents.runs.metrics import read_rows
from agents.runs.provenance import note_provenance
from agents.runs.run import Run, RunOptions
from agents.sweeps import figures, records, tables
from helpers.paths import ROOT
from helpers.refusal import assert_refused
from helpers.small_runs import small_config, stored_run

RESULTS = ROOT / "benchmarks" / "results"
RECORDS = (
    "exp1_code",
    "exp2_best",
    "exp2_curiosities",
    "exp2_paper",
    "exp2_paper_encoder",
    "fast_base",
    "ingredients",
)
ABOUT: records.About = {
    "title": "x", "commands": [], "train_set": "pstsy", "threshold": 1.0,
    "settings": {}, "machines": [], "unfinished": [],
}  # fmt: skip


def rows(algorithm, solved, *, task_set="p", purpose="test", iteration=2, tasks=10, layouts=None):
    """Returns a row of results per seed."""
    few = {} if layouts is None else {"layouts": layouts, "layouts_total": 5}
    return [
        {
            "algorithm": algorithm, "seed": seed, "purpose": purpose, "task_set": task_set,
            "iteration": iteration, "tasks": tasks, "solved": count,
            "layouts": np.nan, "layouts_total": np.nan, **few,
        }
        for seed, count in enumerate(solved)
    ]  # fmt: skip


def curves(algorithm="ppo", evaluations=((0, 1), (0, 0, 1))):
    """Returns a row of metrics per seed and iteration."""
    return pd.DataFrame(
        {
            "algorithm": algorithm, "seed": seed, "iteration": i, "episodes": 100 * i,
            "transitions": 1000 * i, "seconds": 60.0 * i, "success": share / 2,
            "validation_success": share,
        }
        for seed, shares in enumerate(evaluations)
        for i, share in enumerate(shares, 1)
    )  # fmt: skip


def of_a_run(table):
    """Returns the rows of a table as the file of a run has them."""
    return pd.DataFrame(table).drop(columns=["algorithm", "seed"]).to_dict("records")


CURVE = of_a_run(curves(evaluations=((0, 1),)))


@pytest.mark.parametrize(
    ("values", "high", "text"),
    [
        ([50.0, 60.0, 70.0], 100, "60.0 [35.2, 84.8]"),  # 4.303 * 10 / sqrt(3)
        ([0.0, 50.0], 100, "25.0 [0.0, 100.0]"),
        ([7.0, 7.0], 100, "7.0 [7.0, 7.0]"),
        ([7.0], 100, "7.0"),
        ([], 100, "–"),
    ],
)
def test_means_have_clipped_intervals(values, high, text):
    assert tables.mean_text(np.array(values), ".1f", high) == text


def test_success_is_by_set_and_algorithm_with_the_papers_figures():
    results = pd.DataFrame(
        rows("ppo+icm", [5, 6, 7])
        + rows("ppo+icm", [9, 9, 9], iteration=1)  # tested before training went on
        + rows("ppo+icm", [1, 1, 1], purpose="validation", iteration=3)
        + rows("ppo+icm", [6, 6, 8], task_set="sy", layouts=3)
        + rows("ppo+icm", [8, 10, 10], task_set="st")
        + rows("ppo+icm", [10, 10, 10], task_set="base")
        + rows("ppo", [1]) * 2  # its folder was copied
        + rows("ppo", [10], task_set="own")
    )
    table = tables.tables(results, curves(), ABOUT)["Test tasks solved, %"]
    assert list(table) == ["ppo+icm", "ppo", "PPO, paper", "PPO + ICM, paper"]
    assert table.loc["{P}"].tolist() == ["60.0 [35.2, 84.8]", "10.0", "0.0", "2.0 ± 3.0"]
    assert table.loc["{Sy}"].tolist() == ["66.7 (3 of 5)", "–", "35.5 ± 10.9", "40.2 ± 16.9"]
    assert table.loc["{St}", "ppo+icm"] == "93.3 [64.6, 100.0]"
    assert table.loc["own"].tolist() == ["–", "100.0", "–", "–"]
    assert table.loc[tables.MEAN].tolist() == ["60.0 [35.2, 84.8]", "10.0", "–", "–"]  # of {P}
    other = tables.tables(results, curves(), {**ABOUT, "train_set": "sy"})
    assert "PPO, paper" not in other["Test tasks solved, %"]


def test_every_seed_reports_its_newest_policy():
    """Best policies of seeds may be of different iterations."""
    results = pd.DataFrame(rows("ppo", [5, 6]) + rows("ppo", [9], iteration=3))
    reported = tables.reported(results).set_index("seed")
    assert reported["percent"].to_dict() == {0: 90, 1: 60}


def test_differences_are_from_the_first_algorithm_and_corrected_for_their_number():
    tested = tables.reported(
        pd.DataFrame(
            rows("best", [5, 6, 7])
            + rows("worse", [1, 2, 3])
            + rows("alike", [5, 6, 7])
            + rows("single", [1])
            + [
                row
                for name in ("best", "worse")
                for row in rows(name, [1, 5], task_set="st", layouts=1)
            ]
        )
    )
    found = tables.differences(tested).set_index(["task_set", "algorithm"])
    assert list(found.index.unique("algorithm")) == ["worse", "alike"]
    assert list(found.index.unique("task_set")) == ["p", tables.MEAN]  # not st, of few layouts
    # Welch: t = 40 / sqrt(100 / 3 + 100 / 3) at 4 degrees of freedom, p = 0.00806; twice, by Holm.
    worse = found.loc[("p", "worse")]
    assert worse["difference"] == pytest.approx(-40)
    assert worse["p"] == pytest.approx(0.01612, abs=1e-4)
    # t at 1 - 0.05 / 2 / 2 is 3.495.
    np.testing.assert_allclose(worse[["low", "high"]].tolist(), [-68.54, -11.46], atol=0.01)
    alike = found.loc[("p", "alike")]  # the larger p counts once: t at 1 - 0.05 / 2 is 2.776
    np.testing.assert_allclose(alike[["low", "high"]].tolist(), [-22.67, 22.67], atol=0.01)
    assert alike["p"] == 1
    shown = tables.tables(tested, curves(), ABOUT)["Difference from best, points"]
    assert shown.loc["{P}"].tolist() == ["-40.0 [-68.5, -11.5]*", "+0.0 [-22.7, 22.7]"]


@pytest.mark.parametrize(
    ("p", "corrected"),
    [
        ([0.01, 0.04, 0.03], [0.03, 0.06, 0.06]),  # Holm (1979): 3 * 0.01, 2 * 0.03, then no less
        ([0.5, 0.02], [0.5, 0.04]),
        ([0.0, 0.0, 0.1], [0.0, 0.0, 0.1]),
        ([0.2], [0.2]),
        ([0.03, np.nan, 0.02], [0.04, np.nan, 0.04]),  # without a test
        ([np.nan], [np.nan]),
    ],
)
def test_holms_factors_never_let_a_larger_p_pass_a_smaller_one(p, corrected):
    np.testing.assert_allclose(tables.holm_factors(np.array(p)) * p, corrected)


@pytest.mark.parametrize(
    ("solved", "means", "shown"),
    [
        (  # seeds that do not vary have no test
            {"p": {"a": [300] * 5, "b": [300] * 10, "c": [400] * 5, "d": [300] * 4 + [400]}},
            {"{P}": [30, 30, 40, 32], tables.MEAN: [30, 30, 40, 32]},
            {x: ["+0.0", "+10.0", "+2.0 [-3.6, 7.6]"] for x in ("{P}", tables.MEAN)},
        ),
        (  # nor have means over sets that differ by rounding alone
            {
                "p": {"a": [1, 3, 2], "b": [1, 4, 2]},
                "st": {"a": [2, 2, 1], "b": [2, 2, 4]},
                "sy": {"a": [3, 1, 3], "b": [4, 1, 1]},
            },
            {"{P}": [0.2, 0.7 / 3], "{St}": [0.5 / 3, 0.8 / 3], "{Sy}": [0.7 / 3, 0.2],
             tables.MEAN: [0.2, 0.7 / 3]},
            {"{P}": ["+0.0 [-0.3, 0.3]"], "{St}": ["+0.1 [-0.1, 0.3]"],
             "{Sy}": ["+0.0 [-0.4, 0.3]"], tables.MEAN: ["+0.0"]},
        ),
        (  # the mean leaves out base
            {"p": {"a": [500, 700], "b": [100, 100]}, "base": {"a": [900] * 2, "b": [1000] * 2}},
            {"base": [90, 100], "{P}": [60, 10], tables.MEAN: [60, 10]},
            {"base": ["+10.0"], **{x: ["-50.0 [-177.1, 77.1]"] for x in ("{P}", tables.MEAN)}},
        ),
        (  # and there is none of base alone
            {"base": {"a": [500, 600], "b": [500, 700]}},
            {"base": [55, 60]},
            {"base": ["+5.0 [-64.2, 74.2]"]},
        ),
        (  # seeds and algorithms that lack a set leave it to the others
            {
                "st": {name: [500, 600, 700] for name in "abcd"},
                "p": {"a": [500, 600, 700], "b": [100, 200], "c": [100]},
            },
            {"{P}": [60, 15, 10, np.nan], "{St}": [60] * 4, tables.MEAN: [60] * 4},
            {"{P}": ["-45.0 [-69.9, -20.1]*", "–", "–"],
             **{x: 3 * ["+0.0 [-32.3, 32.3]"] for x in ("{St}", tables.MEAN)}},
        ),
        (  # a seed that lacks a set has no mean
            {"p": {"a": [500, 600], "b": [700, 800]}, "st": {"a": [900], "b": [700] * 2}},
            {"{P}": [55, 75], "{St}": [90, 70], tables.MEAN: [70, 72.5]},
            {"{P}": ["+20.0 [-10.4, 50.4]"]},
        ),
        (  # with one seed there is nothing to compare; a set that one lacks is not in the mean
            {"p": {"a": [500], "b": [600, 700], "c": [700] * 2}, "mine": {"b": [0, 200]}},
            {"{P}": [50, 65, 70], "mine": [np.nan, 10, np.nan], tables.MEAN: [50, 65, 70]},
            {},
        ),
    ],
)  # fmt: skip
def test_scores_may_be_missing_or_not_vary(solved, means, shown):
    """Of 1,000 tasks: solved by set, algorithm and seed; percents by set and algorithm."""
    given = [
        row
        for task_set, by_algorithm in solved.items()
        for name, counts in by_algorithm.items()
        for row in rows(name, counts, task_set=task_set, tasks=1000)
    ]
    tested = tables.reported(pd.DataFrame(given))
    table = tables.success_table(tested, with_paper=False)
    numbers = [[float(text.replace("–", "nan").split()[0]) for text in row] for row in table.values]
    assert list(table.index) == list(means)
    np.testing.assert_allclose(numbers, list(means.values()), atol=0.05)
    axes = figures.draw_success(tested, {**ABOUT, "train_set": "st"}).axes
    assert [axis.get_title() for axis in axes] == list(means)
    widths = [[bar.get_width() for bar in axis.patches] for axis in axes]
    np.testing.assert_allclose(widths, list(means.values()))
    compared = tables.differences(tested)
    assert bool(len(compared)) == bool(shown)
    if shown:
        found = tables.difference_table(compared)
        assert {name: list(row) for name, row in found.iterrows()} == shown
        figure = figures.draw_differences(compared, ABOUT)
        assert [axis.get_title() for axis in figure.axes] == list(found.index)


def test_training_is_summed_up_with_the_papers_trials():
    three = ((0, 1, 0, 1), (0, 0, 1), (0, 0, 0))  # seed 0 solves it again later
    made = pd.concat([curves("ppo+icm", three), curves("<b>", ((0.5,),))])
    table = tables.training_table(made, 1.0, True)
    assert table.loc["ppo+icm"].tolist() == ["2 of 3", "250 [0, 885]", "3,333", "3.3"]
    assert table.loc["<b>"].tolist() == ["0 of 1", "–", "1,000", "1.0"]
    assert table.loc["PPO + ICM, paper"].tolist()[:2] == ["5 of 5", "102,000 ± 60,000"]
    assert tables.training_table(made, 0.5, False).loc["<b>", "solved"] == "1 of 1"


def test_runs_that_have_tested_nothing_yet_have_a_table_and_curves(tmp_path):
    nothing = pd.DataFrame(rows("ppo", [1], purpose="validation"))
    assert list(tables.tables(nothing, curves(), ABOUT)) == ["Training"]
    (tmp_path / "success.png").touch()  # of an earlier grid
    (path,) = figures.save(tmp_path, nothing, curves(), ABOUT)
    assert path.name == "curves.png"
    assert list(tmp_path.iterdir()) == [path]


def test_curves_are_of_seeds_and_their_mean_only_where_all_end_together():
    results = pd.DataFrame(
        rows("ppo", [3, 4], purpose="validation", iteration=1)
        + rows("ppo", [5, 8], purpose="validation")
    )
    figure = figures.draw_curves(results, curves(evaluations=((0, 1), (0, 0.5))), ABOUT)
    training, greedy, p = figure.axes
    assert [axis.get_title() for axis in figure.axes[1:]] == ["greedy, {P, St, Sy}", "greedy, {P}"]
    assert greedy.lines[-1].get_ydata().tolist() == [0, 75]
    np.testing.assert_allclose(p.lines[-1].get_xydata(), [[1e-3, 35], [2e-3, 65]])
    assert (len(training.lines), len(training.collections)) == (1, 1)  # mean and range
    uneven = figures.draw_curves(results, curves(), ABOUT)
    assert [len(line.get_xdata()) for line in uneven.axes[0].lines] == [2, 3]
    single = figures.draw_curves(results, curves(evaluations=((0, 1),)), ABOUT)
    assert len(single.axes[0].lines) == 1


def test_an_algorithm_without_an_evaluation_has_no_line_there():
    results = pd.DataFrame(
        rows("ppo", [3, 4], purpose="validation", iteration=1)
        + rows("ppo", [5, 8], purpose="validation")
    )
    evaluations = ((0, 1), (0, 0.5))
    both = pd.concat([curves(name, evaluations) for name in ("ppo", "diverged")])
    figure = figures.draw_curves(results, both, ABOUT)
    assert [len(axis.lines) for axis in figure.axes] == [2, 2, 1]
    assert figure.get_supylabel() == "solved, %: mean and range of seeds"


def test_many_algorithms_are_told_apart(tmp_path):
    names = [f"a{i}" for i in range(8)]
    tested = pd.DataFrame([row for name in names for row in rows(name, [3, 4])])
    many = pd.concat(map(curves, names))
    drawn = figures.save(tmp_path, tested, many, ABOUT)
    assert [path.name for path in drawn] == ["curves.png", "success.png", "differences.png"]
    path = drawn[1]
    lines = figures.draw_curves(tested, many, ABOUT).axes[0].lines
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == len(names)
    with Image.open(path) as picture:
        assert picture.width == 8.3 * figures.DPI
    axis = figures.draw_success(tables.reported(tested), ABOUT).axes[0]
    assert [text.get_text() for text in axis.get_yticklabels()] == [*names, *tables.PAPER_SUCCESS]
    assert axis.lines[0].get_xdata().tolist() == [30, 40]


@pytest.mark.parametrize("record", RECORDS)
def test_the_tables_of_the_records_fit_a_terminal(record, tmp_path):
    copy = shutil.copytree(RESULTS / record, tmp_path / record)
    shown = records.write_tables(copy)
    assert "**Test tasks solved, %**" in (copy / "table.md").read_text()
    assert max(map(len, shown.splitlines())) <= records.WIDTH


def test_sets_of_equal_transfers_are_told_apart_and_one_may_be_named_na(tmp_path, fresh_task_sets):
    for short in ("NA", "other"):
        tt.register(f"{short}-v0", (tt.symbolic,), short=short)
    tested = rows("ppo", [3], task_set="NA") + rows("ppo", [4], task_set="other")
    greedy = [{**row, "purpose": "validation", "iteration": i} for row in tested for i in (1, 2)]
    pd.DataFrame(tested + greedy).to_csv(tmp_path / "results.csv", index=False)
    results = read_rows(tmp_path / "results.csv")
    table = tables.tables(results, curves(), ABOUT)["Test tasks solved, %"]
    assert table.loc[["NA", "other"], "ppo"].tolist() == ["30.0", "40.0"]
    figure = figures.draw_curves(results, curves(), ABOUT)
    assert {"greedy, NA", "greedy, other"} <= {axis.get_title() for axis in figure.axes}


def test_a_table_marks_unfinished_runs_and_names_all_commands(tmp_path):
    for seed, iterations in ((0, 2), (1, 3)):
        run = Run(small_config(iterations=iterations, stop_when_solved=0), seed)
        stored_run(tmp_path / f"seed{seed}", run, CURVE, of_a_run(rows("ppo", [1])))
    extended = Run(small_config(iterations=9, stop_when_solved=0), 0)
    unstored = Run(small_config(), 2)
    launched = {tmp_path / "seed0": extended, tmp_path / "seed2": unstored}
    for command in ("first", "second", "first"):
        records.collect(tmp_path, command, launched, [])
    shown = records.write_tables(tmp_path)
    assert "2 of 2" in shown
    left = (f"ppo+effects seed {seed}" for seed in range(3))
    note = f"Unfinished, so the table may change: {', '.join(left)}."
    assert note in " ".join(shown.split())
    text = (tmp_path / "table.md").read_text()
    assert "\n    first\n\n    second\n" in text
    about = read_json(tmp_path / "grid.json")
    assert about["commands"] == ["first", "second"]
    assert about["threshold"] == 1, "runs that never stop early have solved what they solve whole"


def test_a_grid_over_task_sets_is_not_one_of_the_papers(tmp_path):
    for name, threshold in (("base", 0.5), ("sy", 0.9)):
        run = Run(small_config(env_id=name, stop_when_solved=threshold))
        stored_run(tmp_path / name, run, CURVE)
    records.collect(tmp_path, "sweep", {}, [])
    about = read_json(tmp_path / "grid.json")
    assert about["title"].endswith(": trained on base or {Sy}")
    assert about["train_set"] == "training set"
    assert about["threshold"] == 0.9, "what one run solves is solved by the standard of all"
    assert "Training; solved: 90 % of the tasks" in records.write_tables(tmp_path)


def test_what_others_have_written_is_plain_text(tmp_path):
    folder = stored_run(tmp_path / "seed0", Run(small_config()), CURVE)
    note_provenance(folder.provenance, "cpu")
    (machine,) = read_json(folder.provenance)
    write_json(folder.provenance, [{**machine, "processor": "<b>[x](y)`"}])
    records.collect(tmp_path, "sweep `<script>`", {}, [])
    records.write_tables(tmp_path)
    text = (tmp_path / "table.md").read_text()
    assert "\n    sweep `<script>`\n" in text, "a block of code"
    assert r"\<b\>\[x\](y)\`" in text


def test_what_cannot_be_made_again_is_kept(tmp_path):
    """A note that is written by hand, and rows of runs whose folders are gone."""
    for seed in (0, 1):
        stored_run(tmp_path / f"seed{seed}", Run(small_config(), seed), CURVE)
    records.check(tmp_path, {}, RunOptions())
    records.collect(tmp_path, "first", {}, [])
    about = read_json(tmp_path / "grid.json")
    write_json(tmp_path / "grid.json", {**about, "note": "mine"})
    records.collect(tmp_path, "second", {}, [])
    assert read_json(tmp_path / "grid.json")["note"] == "mine"
    records.write_tables(tmp_path)
    assert "\n\nmine\n\n" in (tmp_path / "table.md").read_text()
    records.check(tmp_path, {}, RunOptions())
    shutil.rmtree(tmp_path / "seed1")
    words = ["curves.csv has rows of runs whose folders are gone: ppo+effects seed 1;"]
    assert_refused(words, records.check, tmp_path, {}, RunOptions())
    again = {tmp_path / "seed1": Run(small_config(), 1)}
    records.check(tmp_path, again, RunOptions())


@pytest.mark.parametrize(
    ("settings", "options", "words"),
    [
        ({"learning_rate": 0.5}, {}, "seed0 has learning_rate=0.001, not 0.5; nothing may change"),
        ({"iterations": 9}, {}, "seed0 has iterations=2, not 9; nothing may change"),
        ({}, {"sets": ("p",)}, "seed0 has sets=None, not ('p',); nothing may change"),
    ],
)
def test_seeds_of_other_settings_or_evaluations_are_not_averaged(
    settings, options, words, tmp_path
):
    config = small_config(iterations=2, learning_rate=0.001)
    stored_run(tmp_path / "seed0", Run(config))
    stored_run(tmp_path / "other", Run(config, algorithm="other"))
    later = {tmp_path / "seed1": Run(dataclasses.replace(config, **settings), 1)}
    assert_refused([words, "another --name"], records.check, tmp_path, later, RunOptions(**options))
    records.check(tmp_path, {tmp_path / "seed1": Run(config, 1)}, RunOptions())


def test_an_unknown_set_of_a_stored_run_is_refused_before_training(tmp_path):
    folder = stored_run(tmp_path / "seed0", Run(small_config()))
    folder.config.write_text(folder.config.read_text().replace("TrapTube-v0", "Gone-v0"))
    words = ["seed0/config.json", "unknown task set 'Gone-v0'", "--import"]
    assert_refused(words, records.check, tmp_path, {}, RunOptions())


def test_tables_follow_the_order_of_the_points(tmp_path):
    """So that the first one is what the others are compared with."""
    for name in ("a", "b", "c", "d"):
        run = Run(small_config(), algorithm=name)
        stored_run(tmp_path / name, run, CURVE, of_a_run(rows(name, [1])))
    records.collect(tmp_path, "sweep", {}, ["d", "b", "c"])
    for name in ("results", "curves"):
        found = read_rows(tmp_path / f"{name}.csv")["algorithm"]
        assert list(found.unique()) == ["d", "b", "c", "a"]


def test_a_figure_that_fails_costs_a_line(tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise RuntimeError("no font")

    monkeypatch.setattr(figures, "draw_success", fail)
    (path,) = figures.save(tmp_path, pd.DataFrame(rows("ppo", [3])), curves(), ABOUT)
    assert path.name == "curves.png"
    warning = f"warning: {tmp_path / 'success.png'} was not drawn: no font\n"
    assert capsys.readouterr().err == warning
