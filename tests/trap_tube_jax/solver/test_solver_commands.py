"""Surveys of task sets, and the command line of the solver."""

import json
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image

import trap_tube_jax as tt
from refusal import refused
from trap_tube_jax.solver.__main__ import _caption, main
from trap_tube_jax.solver.survey import Survey, survey


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": 0}, "tasks must be an integer >= 1, got 0"),
        ({"tasks": 2, "seed": 2**32}, "seed must be .* <= 4294967295, got 4294967296"),
    ],
)
def test_survey_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        survey(tt.task_set("p"), **options)


def test_survey_takes_every_task_of_the_seed_once(monkeypatch):
    """Numbers stand for the tasks and for their plans."""
    for name, replacement in {
        "draw_tasks": lambda entry, tasks, seed: 10 * seed + np.arange(tasks),
        "solve_batch": lambda tasks: SimpleNamespace(length=tasks),
    }.items():
        monkeypatch.setattr(f"trap_tube_jax.solver.survey.{name}", replacement)
    found = survey(tt.task_set("p"), tasks=5, seed=4)
    assert found.length.tolist() == [40, 41, 42, 43, 44]
    assert found.seed == 4


def test_the_figures_of_a_survey():
    found = Survey(tt.task_set("p"), 3, np.array([4, -1, 8, 6, -1])).summary()
    quantiles = found.pop("quantiles")
    assert found == {
        "id": "PerceptualTrapTube-v0",
        "tasks": 5,
        "seed": 3,
        "solvable": 0.6,
        "mean": 6,
        "longest": 8,
    }
    assert quantiles == pytest.approx({"5": 4.2, "25": 5, "50": 6, "75": 7, "95": 7.8})


def test_command_line_surveys_task_sets(tmp_path, capsys):
    picture = tmp_path / "histogram.png"
    arguments = ["--tasks", "12", "--output", str(picture), "--sets"]
    main([*arguments, "sy", "--format", "json"])
    (found,) = json.loads(capsys.readouterr().out)
    assert (found["id"], found["tasks"], found["solvable"]) == ("SymbolicTrapTube-v0", 12, 1)
    assert 8 <= found["mean"] <= found["longest"] <= 16
    main([*arguments, "base"])
    assert "| base |    12 | 100.00 % | 11.0 |  11 |" in capsys.readouterr().out
    with Image.open(picture) as image:
        assert image.format == "PNG"


def test_command_line_shows_a_plan_without_matplotlib(tmp_path, capsys, monkeypatch):
    for module in ("matplotlib", "trap_tube_jax.solver.pictures"):
        monkeypatch.setitem(sys.modules, module, None)
    animation = tmp_path / "plan.gif"
    arguments = ["--show", "SymbolicTrapTube-v0", "--seed", "3", "--output", str(animation)]
    main([*arguments, "--format", "json"])
    plan = json.loads(capsys.readouterr().out)
    state, _ = tt.make("sy").reset(jax.random.key(3))
    assert plan["actions"] == tt.solve(state).actions.tolist()
    main(arguments)
    text = capsys.readouterr().out
    assert f"step {plan['length']}: grasp" in text
    assert tt.render_ascii(state) in text
    with Image.open(animation) as image:
        assert image.format == "GIF"


def test_command_lines_write_before_they_print(tmp_path, monkeypatch):
    def print_nothing(*words, **options):
        raise BrokenPipeError

    monkeypatch.setattr("builtins.print", print_nothing)
    monkeypatch.setattr("os.dup2", lambda *files: None)
    with pytest.raises(SystemExit):
        main(["--show", "base", "--output", str(tmp_path / "plan.gif")])
    assert [path.name for path in tmp_path.iterdir()] == ["plan.gif"]


@pytest.mark.slow
def test_command_line_draws_distances(tmp_path, capsys):
    picture = tmp_path / "distances.png"
    main(["--distances", "base", "--output", str(picture)])
    lines = capsys.readouterr().out.splitlines()
    assert {"id: TrapTube-v0", "seed: 0", "length: 11", "reachable: 1547184"} < set(lines)
    with Image.open(picture) as image:
        assert image.format == "PNG"


def test_captions_of_a_plan():
    actions = np.array([[0, 3], [1, 2]], np.int32)
    plan = tt.Plan(actions, np.array(2), np.array(True))
    assert [_caption(plan, time) for time in range(3)] == [
        "start (2 steps)",
        "step 1: grasp up, move right",
        "step 2: grasp down, move left",
    ]
    unsolvable = tt.Plan(actions[:0], np.array(-1), np.array(False))
    assert _caption(unsolvable, 0) == "start (unsolvable)"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--show", "p", "--distances", "p"], "not allowed with argument --show"),
        (["--show", "nowhere"], "unknown task set 'nowhere'"),
        (["--tasks", "0"], "tasks must be an integer >= 1"),
        (["--seed", str(2**32)], "seed must be an integer >= 0 and <= 4294967295"),
        (["--show", "base", "--seed", "-1"], "seed must be an integer >= 0"),
        (["--sets"], "--sets: expected at least one argument"),
        (["--format", "csv"], "choose from"),
    ],
)
def test_command_line_refuses(arguments, message, capsys):
    assert message in refused(capsys, main, *arguments)


def test_runs_as_a_module_without_warnings():
    command = [sys.executable, "-W", "error", "-m", "trap_tube_jax.solver", "--help"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert "--distances" in result.stdout
