"""The command line of the solver."""

import sys

import jax
import numpy as np
import pytest
from PIL import Image

import trap_tube_jax as tt
from helpers.easy_task import EASY
from helpers.refusal import refused
from trap_tube_jax.solver.__main__ import main, row_of_lengths


def test_statistics_of_shortest_plans():
    row = row_of_lengths("{P}", np.array([4, -1, 8, 6, -1]))
    assert row == ["{P}", "5", "60.00 %", "6.0", "4", "5", "6", "7", "8", "8"]
    assert row_of_lengths("none", np.array([-1])) == ["none", "1", "0.00 %", *["-"] * 7]


def test_command_line_surveys_task_sets(tmp_path, capsys):
    picture = tmp_path / "histogram.png"
    arguments = ["--tasks", "12", "--seed", "4", "--output", str(picture), "--sets", "sy", "base"]
    main(arguments)
    text = capsys.readouterr().out
    states, _ = jax.jit(jax.vmap(tt.make("sy").reset))(jax.random.split(jax.random.key(4), 12))
    row = row_of_lengths("{Sy}", tt.solve_batch(states).length)
    assert row in [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    assert "| base |    12 | 100.00 % | 11.0 |  11 |" in text
    with Image.open(picture) as image:
        assert image.format == "PNG"
    main(["--distances", "too-short-tool", "--output", str(picture)])
    assert "length of the plan: unsolvable" in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--tasks", "2", "--sets", "base"], "| base |     2 | 100.00 % | 11.0 |"),
        (["--show", "too-short-tool"], "start (unsolvable)"),
        (["--distances", "too-short-tool"], "length of the plan: unsolvable"),
    ],
)
def test_text_needs_no_library_of_pictures(arguments, text, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for module in ("PIL", "matplotlib", "matplotlib.axes"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "trap_tube_jax.solver.pictures", raising=False)
    main(arguments)
    printed = capsys.readouterr()
    assert text in printed.out
    hint = "pip install 'trap-tube-jax[pictures]'"
    assert printed.err.splitlines()[-1].startswith("no picture: ")
    assert hint in printed.err
    assert not list(tmp_path.iterdir())
    asked = tmp_path / "asked.png"
    assert hint in refused(capsys, main, *arguments, "--output", asked)


@pytest.mark.usefixtures("fresh_task_sets")
def test_sets_of_the_same_transfers_have_rows_of_their_names(tmp_path, capsys):
    tt.register("Own-v0", (tt.symbolic,), short="own", base=EASY)
    picture = str(tmp_path / "histogram.png")
    main(["--tasks", "2", "--output", picture, "--sets", "sy", "own", "{Sy}"])
    lines = capsys.readouterr().out.splitlines()
    names = [line.split()[1] for line in lines if line.startswith("|")]
    assert names[2:] == ["{Sy}", "own"], "below the head and the rule"


def test_command_line_shows_a_plan_without_matplotlib(tmp_path, capsys, monkeypatch):
    for module in ("matplotlib", "trap_tube_jax.solver.pictures"):
        monkeypatch.setitem(sys.modules, module, None)
    animation = tmp_path / "plan.gif"
    arguments = ["--show", "SymbolicTrapTube-v0", "--seed", "3", "--output", str(animation)]
    main(arguments)
    with Image.open(animation) as image:
        assert image.format == "GIF"
    state, _ = tt.make("sy").reset(jax.random.key(3))
    plan = tt.solve(state)
    text = capsys.readouterr().out
    assert text.startswith(f"start ({plan.length} steps)\n{tt.render_ascii(state)}\n")
    for time, action in enumerate(plan.actions, start=1):
        grasp, move = (("up", "down", "left", "right")[code] for code in action)
        assert f"step {time}: grasp {grasp}, move {move}" in text


def test_command_line_shows_that_there_is_no_plan(tmp_path, capsys):
    animation = tmp_path / "new" / "plan.gif"
    main(["--show", "too-short-tool", "--output", str(animation)])
    assert animation.exists(), "the folder is made"
    assert capsys.readouterr().out.startswith("start (unsolvable)\n")


@pytest.mark.slow
def test_command_line_draws_distances(tmp_path, capsys):
    picture = tmp_path / "distances.png"
    main(["--distances", "base", "--output", str(picture)])
    lines = capsys.readouterr().out.splitlines()
    assert {"length of the plan: 11", "states with a way to the goal: 1547184"} < set(lines)
    with Image.open(picture) as image:
        assert image.format == "PNG"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--show", "p", "--distances", "p"], "not allowed with argument --show"),
        (["--show", "p", "--tasks", "9"], "--sets and --tasks are not allowed with --show"),
        (["--distances", "p", "--sets", "p"], "--sets and --tasks are not allowed with --show"),
        (["--show", "nowhere"], "unknown task set 'nowhere'"),
        (["--tasks", "0"], "tasks must be an integer >= 1"),
        (["--tasks", "1000000000"], "<= 1000000, got 1000000000"),
        (["--seed", str(2**32)], "seed must be an integer >= 0 and <= 4294967295"),
        (["--show", "base", "--seed", "-1"], "seed must be an integer >= 0"),
        (["--sets"], "--sets: expected at least one argument"),
    ],
)
def test_command_line_refuses(arguments, message, capsys):
    assert message in refused(capsys, main, *arguments)
