"""Results of a run for a reader: curves, a GIF, the page, and lines on the terminal."""

import base64
import io
import json
import re

import jax
import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from PIL import Image
from rich.console import Console

import trap_tube_jax as tt
from agents.runs import display, provenance, report
from agents.runs.evaluator import Evaluator
from agents.runs.folder import RunFolder
from agents.runs.metrics import append_rows
from agents.runs.provenance import commit, note_provenance, read_provenance
from agents.runs.run import Run
from helpers.small_runs import metrics_row, small_config
from helpers.tiny_policy import food_next_to_agent, random_params
from trap_tube_jax.objects import DIRECTION_NAMES
from trap_tube_jax.scoring import Suite, evaluation_tasks

CONFIG = small_config(curiosity="effects", stop_when_solved=0.0)


@pytest.fixture(scope="module")
def played():
    """An untrained policy's outcomes on tasks of base, {P} and a set of known outcome."""
    tasks = {name: evaluation_tasks(name, 2) for name in ("base", "p")}
    tasks["mine"] = food_next_to_agent(3)
    evaluator = Evaluator(CONFIG, Suite(tasks, dict.fromkeys(tasks, 6)))
    return evaluator.suite, evaluator(random_params(CONFIG))


@pytest.fixture(scope="module")
def page(played, tmp_path_factory):
    """The folder of a report, and the episodes that the page's script reads."""
    suite, outcome = played
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "<mine>")
    folder.path.mkdir()
    append_rows(folder.metrics, [metrics_row(1), metrics_row(2, policy_loss=0.5)])
    note_provenance(folder.provenance, "cpu")
    report.write(folder, Run(CONFIG), suite, outcome)
    start = '<script type="application/json" id="data">'
    end = "</script>"
    return folder, json.loads(folder.page.read_text().partition(start)[2].partition(end)[0])


def test_a_page_needs_no_network_and_holds_the_settings(page):
    text = page[0].page.read_text()
    assert "<h1>&lt;mine&gt;</h1>" in text
    assert "&quot;hidden&quot;: 4" in text
    assert "<tr><td>{P}</td><td>2</td>" in text
    assert f"commit {commit() or 'unknown'}, jax {jax.__version__}" in text
    assert not re.search(r"https?:|(src|href)=\"(?!data:)", text)
    assert "NaN" not in text


def test_a_page_shows_solved_and_unsolved_episodes(played, page):
    outcome = played[1]["mine"]
    solved, unsolved = (int(np.argmax(outcome.solved == which)) for which in (True, False))
    mine = [episode for episode in page[1] if episode["title"].startswith("mine")]
    assert [episode["title"] for episode in mine] == [
        f"mine, task {solved}: solved",
        f"mine, task {unsolved}: not solved",
    ]
    for index, episode in zip((solved, unsolved), mine, strict=True):
        length = outcome.length[index]
        assert len(episode["agent"]["frames"]) == length + 1
        assert len(episode["agent"]["actions"]) == length
        np.testing.assert_allclose(episode["values"], outcome.value[index, :length], atol=1e-4)
        for frame in episode["agent"]["frames"]:
            with Image.open(io.BytesIO(base64.b64decode(frame))) as picture:
                assert picture.size == (192, 192)


def test_a_page_shows_shortest_plans(played, page):
    """From the same board as the episode, and with as many steps as are needed."""
    for episode in page[1]:
        name, _, number = episode["title"].partition(":")[0].partition(", task ")
        steps = {"base": 11, "mine": 1}.get(name)
        plan = episode["plan"]
        assert len(plan["frames"]) == len(plan["actions"]) + 1
        if steps is not None:
            assert len(plan["actions"]) == steps
        tasks = played[0].tasks[{"{P}": "p"}.get(name, name)]
        state = jax.tree.map(lambda x, i=int(number): x[i], tasks)
        first = DIRECTION_NAMES.index(plan["actions"][0].split()[1].rstrip(","))
        shown = np.asarray(tt.render(state, 16, grasp=first))
        assert plan["frames"][0] == report._png(shown)


def test_curves_have_as_many_panels_where_nothing_is_solved():
    heights = []
    for share in (0.0, 0.5):
        rows = pd.DataFrame(
            [metrics_row(i, success=share, validation_success=share) for i in (1, 2)]
        )
        content = report.draw_curves(rows, "no formula: $^$")
        with Image.open(io.BytesIO(content)) as picture:
            heights.append(picture.height)
    assert heights[0] == heights[1]


def test_curves_show_every_loss(monkeypatch):
    shown = []
    monkeypatch.setattr(Axes, "plot", lambda *_, label, **__: shown.append(label))
    monkeypatch.setattr(Axes, "legend", lambda *_, **__: None)
    rows = pd.DataFrame([metrics_row(1, loss=1.0, policy_loss=0.0, motion_loss=0.0, my_loss=0.0)])
    report.draw_curves(rows, "")
    losses = [label for label in shown if "loss" in label]
    assert losses == ["policy loss", "motion loss", "my loss"]


def test_figures_are_drawn_under_matplotlibs_defaults(played, tmp_path, monkeypatch, capsys):
    """Here by a reader whose settings ask for a LaTeX that is not there."""
    monkeypatch.setitem(mpl.rcParams, "text.usetex", True)
    monkeypatch.setenv("PATH", "")
    folder = RunFolder(tmp_path)
    append_rows(folder.metrics, [metrics_row(1)])
    report.write(folder, Run(CONFIG), *played)
    assert folder.curves.is_file()
    assert mpl.rcParams["text.usetex"]
    assert not capsys.readouterr().err


def test_a_figure_that_fails_costs_a_line_and_leaves_the_other_files(
    played, tmp_path, monkeypatch, capsys
):
    def fail(*args, **kwargs):
        raise RuntimeError("no font\nwas found")

    folder = RunFolder(tmp_path)
    append_rows(folder.metrics, [metrics_row(1)])
    folder.curves.write_text("earlier")
    monkeypatch.setattr(report, "to_png", fail)
    report.write(folder, Run(CONFIG), *played)
    assert folder.page.is_file()
    assert folder.curves.read_text() == "earlier"
    warning = f"warning: {folder.curves} was not drawn: no font was found\n"
    assert capsys.readouterr().err == warning


def test_a_solved_episode_becomes_a_gif(played, tmp_path):
    suite, outcome = played
    path = tmp_path / "solved.gif"
    assert report.save_first_solved(path, suite, outcome, prefer="base") == "mine"
    with Image.open(path) as picture:
        index = int(np.argmax(outcome["mine"].solved))
        assert getattr(picture, "n_frames", 1) == outcome["mine"].length[index] + 1
    unsolved = {"base": outcome["base"]}
    folder = RunFolder(tmp_path)
    append_rows(folder.metrics, [metrics_row(1)])
    report.write(folder, Run(CONFIG), suite, unsolved)
    assert not path.exists(), "it was of an earlier policy"
    assert report.save_first_solved(tmp_path / "x.gif", suite, unsolved, "base") is None
    assert not (tmp_path / "x.gif").exists()


@pytest.mark.parametrize("is_terminal", [True, False])
def test_progress_is_one_line_on_a_terminal_and_a_line_an_iteration_elsewhere(is_terminal):
    file = io.StringIO()
    console = Console(file=file, force_terminal=is_terminal, width=100)
    with display.TrainingLine(console, 5) as progress:
        for iteration in (1, 2):
            progress.show(metrics_row(iteration))
    text = file.getvalue()
    assert "25.0% solved, 50.0% greedily, 16 episodes, 6,000 steps/s" in text
    assert ("iteration 2 of 5: " in text) != is_terminal
    assert ("2/5" in text) == is_terminal


def test_a_narrow_terminal_shows_total_time_left_and_success():
    console = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    with display.TrainingLine(console, 1150) as progress, console.capture() as shown:
        numbers = {"success": 1.0, "validation_success": 1.0, "episodes": 1_177_600}
        progress.show(metrics_row(1149, **numbers))
    assert re.search(r"1149/1150 .* left, 100.0% solved, 100.0% greedily, ", shown.get())


def test_the_newest_commit_of_a_run_is_noted_last(tmp_path, monkeypatch):
    path = tmp_path / "provenance.json"
    for name in ("aaaa", "bbbb", "aaaa"):
        monkeypatch.setattr(provenance, "commit", lambda name=name: name)
        note_provenance(path, "cpu")
    assert [machine["commit"] for machine in read_provenance(path)] == ["bbbb", "aaaa"]
