"""The command line of the solver."""

import jax
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.easy_task import EASY
from helpers.refusal import refused
from trap_tube_jax.solver.__main__ import main, row_of_lengths


def test_statistics_of_shortest_plans():
    row = row_of_lengths("{P}", np.array([4, -1, 8, 6, -1]))
    assert row == ["{P}", "5", "60.00 %", "6.0", "4", "5", "6", "7", "8", "8"]
    assert row_of_lengths("none", np.array([-1])) == ["none", "1", "0.00 %", *["-"] * 7]


def test_command_line_surveys_task_sets(capsys):
    main(["--tasks", "12", "--seed", "4", "--sets", "sy", "base"])
    text = capsys.readouterr().out
    states, _ = jax.jit(jax.vmap(tt.make("sy").reset))(jax.random.split(jax.random.key(4), 12))
    row = row_of_lengths("{Sy}", tt.solve_batch(states).length)
    assert row in [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    assert "| base |    12 | 100.00 % | 11.0 |  11 |" in text


@pytest.mark.usefixtures("fresh_task_sets")
def test_sets_of_the_same_transfers_have_rows_of_their_names(capsys):
    tt.register("Own-v0", (tt.symbolic,), short="own", base=EASY)
    main(["--tasks", "2", "--sets", "sy", "own", "{Sy}"])
    lines = capsys.readouterr().out.splitlines()
    names = [line.split()[1] for line in lines if line.startswith("|")]
    assert names[2:] == ["{Sy}", "own"], "below the head and the rule"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sets", "nowhere"], "unknown task set 'nowhere'"),
        (["--tasks", "0"], "tasks must be an integer >= 1"),
        (["--tasks", "1000000000"], "<= 1000000, got 1000000000"),
        (["--seed", str(2**32)], "seed must be an integer >= 0 and <= 4294967295"),
        (["--seed", "-1"], "seed must be an integer >= 0"),
        (["--sets"], "--sets: expected at least one argument"),
    ],
)
def test_command_line_refuses(arguments, message, capsys):
    assert message in refused(capsys, main, *arguments)
