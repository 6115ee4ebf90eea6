"""Rows of numbers on disk, and what follows from them."""

import numpy as np
import pytest

from agents.config import Config
from agents.runs.metrics import CsvLog, is_last, read_rows


def row(iteration, seed=0, **values):
    counts = {"episodes": 8 * iteration, "transitions": 48 * iteration, "seconds": 1.0 * iteration}
    return {"seed": seed, "iteration": iteration, "evaluation": 0.0, **counts, **values}


def test_rows_after_the_checkpoint_and_torn_ones_are_dropped(tmp_path):
    path = tmp_path / "metrics.csv"
    log = CsvLog(path)
    for iteration in (1, 2, 3):
        log.append([row(iteration, loss=float(np.float32(1 / 3)), length="")])
    with path.open("a") as file:
        file.write("0,2,1")  # a kill in mid-write
    log = CsvLog(path, last_iteration=2)
    assert [entry["iteration"] for entry in log.rows] == [1, 2]
    log.append([row(3, loss=0.5, length=7)])
    assert read_rows(path) == log.rows
    assert read_rows(path)[0]["loss"] == float(np.float32(1 / 3))
    assert read_rows(path)[0]["length"] == ""


def test_a_file_deleted_in_mid_training_is_begun_again_with_its_header(tmp_path):
    log = CsvLog(tmp_path / "x.csv")
    log.append([row(1)])
    (tmp_path / "x.csv").unlink()
    log.append([row(2)])
    assert read_rows(tmp_path / "x.csv") == [row(2)]


def test_a_vanished_folder_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        CsvLog(tmp_path / "none" / "x.csv").append([row(1)])


def test_a_file_without_header_is_refused(tmp_path):
    (tmp_path / "x.csv").write_text("0,2,1\n0,3,1\n")
    with pytest.raises(ValueError, match=r"x.csv has no header with a column 'iteration'"):
        CsvLog(tmp_path / "x.csv", last_iteration=3)


def test_columns_never_change(tmp_path):
    log = CsvLog(tmp_path / "x.csv")
    log.append([row(1)])
    with pytest.raises(ValueError, match="fields not in fieldnames: 'more'"):
        log.append([row(2, more=1)])


@pytest.mark.parametrize(
    ("settings", "values", "expected"),
    [
        ({"iterations": 4}, {}, True),
        ({"iterations": 5}, {}, False),
        ({"stop_when_solved": 0.5}, {"evaluation": 0.5}, True),
        ({"stop_when_solved": 0.6}, {"evaluation": 0.5}, False),
        ({}, {"evaluation": 1.0}, False),
        ({"max_transitions": 600}, {"transitions": 200}, False),  # 8 * 50 more fit in
        ({"max_transitions": 600}, {"transitions": 201}, True),
    ],
)
def test_the_last_iteration_is_known(settings, values, expected):
    config = Config(episodes_per_iteration=8, minibatch_size=8, **settings)
    assert is_last(row(4, **values), config) == expected
