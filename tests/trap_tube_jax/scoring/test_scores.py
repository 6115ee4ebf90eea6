"""Scores of given outcomes."""

import numpy as np
import pytest

from trap_tube_jax.scoring.scores import Layouts, Optimality, Score, Scores, wilson_interval


def test_optimality_compares_with_shortest_plans():
    found = Optimality.of(
        solved=np.array([True, True, False, False, False]),
        length=np.array([10, 20, 50, 50, 50]),
        shortest=np.array([10, 5, -1, 51, 50]),
        max_steps=50,
    )
    assert found.solvable == 3
    assert found.percent_of_solvable == pytest.approx(200 / 3)
    assert found.mean == 0.625
    nothing = Optimality.of(np.array([False]), np.array([50]), np.array([-1]), 50)
    assert nothing == Optimality(0, None, None)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # R: binom::binom.confint(successes, trials, methods = "wilson").
    [(0, 10, 0.0, 0.27753), (5, 10, 0.23659, 0.76341), (10, 10, 0.72247, 1.0)],
)
def test_intervals_are_wilsons(successes, trials, low, high):
    np.testing.assert_allclose(wilson_interval(successes, trials), (low, high), atol=1e-5)


def test_few_layouts_are_counted_and_have_no_interval():
    solved = np.array([True, True, False, True, False])
    layout = np.array([0, 0, 0, 1, 1])
    score = Score.of("stsy", "{St, Sy}", solved, np.full(5, 9), layout=layout)
    assert (score.percent, score.interval, score.layouts) == (60.0, None, Layouts(1, 2))
    assert str(score.layouts) == "1 of 2"
    score = Score.of("p", "{P}", np.arange(10) < 5, np.full(10, 9))
    assert score.layouts is None
    assert score.interval == pytest.approx((23.659, 76.341), abs=1e-3)
    assert " 23.7-76.3 |" in str(Scores(1, "0", None, (score,)))


def test_a_printed_table_holds_the_numbers_and_fits_a_terminal():
    """One of four tasks has no plan, and one none within 50 steps."""
    solved = np.array([True, True, False, False])
    length = np.array([20, 40, 50, 50])
    found = Optimality.of(solved, length, np.array([10, 10, -1, 51]), 50)
    score = Score.of("pstsy", "{P, St, Sy}", solved, length, optimality=found)
    lines = str(Scores(1, "0.2.0", 0, (score,))).splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    # Shares, Wilson's interval and mean steps; then shares of the solvable, and 10/20 and 10/40.
    assert rows[2] == ["{P, St, Sy}", "4", "2", "50.0", "15.0-85.0", "-", "30.0"]
    assert rows[6] == ["{P, St, Sy}", "100.0", "0.375"]
    assert max(map(len, lines)) <= 80
