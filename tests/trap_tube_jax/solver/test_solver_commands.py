"""Surveys of task sets, and the command line of the solver."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest
from PIL import Image

import trap_tube_jax as tt
from refusal import refused
from trap_tube_jax.solver.__main__ import main
from trap_tube_jax.solver.survey import Survey


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
    arguments = ["--tasks", "12", "--seed", "4", "--output", str(picture), "--sets"]
    main([*arguments, "sy", "--format", "json"])
    (found,) = json.loads(capsys.readouterr().out)
    states, _ = jax.jit(jax.vmap(tt.make("sy").reset))(jax.random.split(jax.random.key(4), 12))
    assert found == Survey(tt.task_set("sy"), 4, tt.solve_batch(states).length).summary()
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
    with Image.open(animation) as image:
        assert image.format == "GIF"
    animation.unlink()

    def print_nothing(*words, **options):
        raise OSError("closed")

    with monkeypatch.context() as closed:
        closed.setattr("builtins.print", print_nothing)
        with pytest.raises(OSError, match="closed"):
            main(arguments)
    assert animation.exists(), "files are written before anything is printed"
    main(arguments)
    text = capsys.readouterr().out
    grasp, move = (("up", "down", "left", "right")[code] for code in plan["actions"][-1])
    assert text.startswith(f"start ({plan['length']} steps)\n{tt.render_ascii(state)}\n")
    assert f"step {plan['length']}: grasp {grasp}, move {move}" in text


def test_command_line_shows_that_there_is_no_plan(tmp_path, capsys):
    main(["--show", "too-short-tool", "--output", str(tmp_path / "plan.gif")])
    assert capsys.readouterr().out.startswith("start (unsolvable)\n")


@pytest.mark.slow
def test_command_line_draws_distances(tmp_path, capsys):
    picture = tmp_path / "distances.png"
    main(["--distances", "base", "--output", str(picture)])
    lines = capsys.readouterr().out.splitlines()
    assert {"id: TrapTube-v0", "seed: 0", "length: 11", "reachable: 1547184"} < set(lines)
    with Image.open(picture) as image:
        assert image.format == "PNG"


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
