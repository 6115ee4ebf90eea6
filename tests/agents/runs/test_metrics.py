"""Rows of numbers on disk, and what follows from them."""

import resource
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from agents.config import Config
from agents.runs.metrics import append_rows, evaluation_rows, is_last, read_rows, rewind_rows
from trap_tube_jax.scoring.scores import Score, Scores


def row(iteration, **values):
    counts = {"episodes": 8 * iteration, "transitions": 48 * iteration, "seconds": 1.0 * iteration}
    return {"iteration": iteration, "validation_success": 0.0, **counts, **values}


def test_rows_after_the_checkpoint_and_torn_ones_are_dropped(tmp_path):
    path = tmp_path / "metrics.csv"
    for iteration in (1, 2, 3):
        append_rows(path, [row(iteration, loss=float(np.float32(1 / 3)), length="")])
    before = path.read_text()
    with path.open("a") as file:
        file.write("4,0.0,3")  # a kill in mid-write
    assert list(read_rows(path)["iteration"]) == [1, 2, 3]
    rewind_rows(path, 2)
    assert path.read_text() == "".join(before.splitlines(keepends=True)[:3])
    append_rows(path, [row(3, loss=float(np.float32(1 / 3)), length="")])
    assert path.read_text() == before
    rewind_rows(path, 0)
    assert read_rows(path).empty
    append_rows(path, [row(1)])
    assert read_rows(path).to_dict("records") == [row(1)], "begun again with its header"


@pytest.mark.parametrize("begun", [True, False])
def test_a_full_disk_leaves_no_part_of_a_row(begun, tmp_path):
    path = tmp_path / "metrics.csv"
    if begun:
        append_rows(path, [row(1)])
    before = path.read_bytes() if begun else b""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) + 8, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            append_rows(path, [row(2)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    append_rows(path, [row(2)])
    assert list(read_rows(path)["iteration"]) == [1, 2][not begun :]


def test_other_columns_are_refused(tmp_path):
    path = tmp_path / "metrics.csv"
    append_rows(path, [row(1)])
    with pytest.raises(ValueError, match=r"metrics.csv has other columns than .*,more; "):
        append_rows(path, [row(2, more=1)])
    path.write_text("2,1\n3,1\n")
    with pytest.raises(ValueError, match=r"metrics.csv cannot be read: it has no column"):
        rewind_rows(path, 3)


def test_a_row_of_another_length_is_refused(tmp_path):
    path = tmp_path / "metrics.csv"
    append_rows(path, [row(1)])
    path.write_text(path.read_text() + "2,0.5\n3,0.5\n")
    with pytest.raises(ValueError, match=r"metrics.csv cannot be read: "):
        read_rows(path)


def test_an_evaluation_row_holds_the_counts_of_a_score():
    solved = np.array([True, True, False])
    layout = np.array([0, 0, 1])
    few = Score.of("sy", "{Sy}", solved, np.array([3, 6, 50]), layout=layout)
    none = Score.of("p", "{P}", np.zeros(4, bool), np.full(4, 50))
    policy: Any = SimpleNamespace(iteration=7)
    names = ("task_set", "tasks", "solved", "layouts", "layouts_total", "length")
    assert evaluation_rows(Scores(1, "0", None, (few, none)), policy, "test") == [
        {"iteration": 7, "purpose": "test", **dict(zip(names, values, strict=True))}
        for values in (("sy", 3, 2, 1, 2, 4.5), ("p", 4, 0, "", "", ""))
    ]


@pytest.mark.parametrize(
    ("settings", "values", "expected"),
    [
        ({"iterations": 4}, {}, True),
        ({"iterations": 5}, {}, False),
        ({"stop_when_solved": 0.5}, {"validation_success": 0.5}, True),
        ({"stop_when_solved": 0.6}, {"validation_success": 0.5}, False),
        ({}, {"validation_success": 1.0}, False),
        ({"max_transitions": 600}, {"transitions": 200}, False),  # 8 * 50 more fit in
        ({"max_transitions": 600}, {"transitions": 201}, True),
    ],
)
def test_training_ends_at_the_first_limit_that_is_reached(settings, values, expected):
    config = Config(episodes_per_iteration=8, minibatch_size=8, **settings)
    assert is_last(row(4, **values), config) == expected
