"""CSV files that a run appends to."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from agents.acting.policy import Policy
from agents.config import Config
from agents.files import write_text
from trap_tube_jax.scoring.scores import Score
from trap_tube_jax.scoring.tasks import Purpose

Row = Mapping[str, Any]
Frame = Any  # pandas.DataFrame; what a type checker infers of pandas is too wide to use


def append_rows(path: Path, rows: Sequence[Row]) -> None:
    """Appends rows to a CSV file, which the first of them begin with a header.

    Raises:
      ValueError: a row has a column that the header lacks.
      OSError: the file cannot be written.
    """
    with path.open("a+", newline="", encoding="utf-8") as file:
        file.seek(0)
        header = next(csv.reader(file), None)
        writer = csv.DictWriter(file, header or list(rows[0]), lineterminator="\n")
        if header is None:
            writer.writeheader()
        writer.writerows(rows)


def read_rows(path: Path) -> Frame:
    """Reads a CSV file of a run; one without rows if it is missing or empty."""
    lines = _whole_lines(path)
    if not lines:
        return pd.DataFrame(columns=["iteration", "purpose", "evaluation", "episodes"])
    return pd.read_csv(io.StringIO("".join(lines)))


def rewind_rows(path: Path, iteration: int) -> None:
    """Deletes the rows after an iteration.

    Raises:
      ValueError: the file has no column `iteration`.
    """
    header, *lines = _whole_lines(path) or [""]
    names = header.rstrip().split(",")
    if header and "iteration" not in names:
        raise ValueError(f"{path} has no header with a column 'iteration'; delete or restore it")
    kept = [line for line in lines if int(line.split(",")[names.index("iteration")]) <= iteration]
    if kept:
        write_text(path, header + "".join(kept))
    else:
        path.unlink(missing_ok=True)


def _whole_lines(path: Path) -> list[str]:
    """Returns the lines of a file without a last one that a killed process wrote in part."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return text[: text.rfind("\n") + 1].splitlines(keepends=True)


def evaluation_rows(scores: Sequence[Score], policy: Policy, purpose: Purpose) -> list[Row]:
    """Returns a row of `evaluations.csv` for each score of a policy.

    `solved` counts tasks. Where a set has few layouts, `layouts` of `layouts_total` are solved in
    more than half of their draws. `length` is the mean number of steps of solved episodes.
    """
    return [
        {
            "iteration": policy.iteration,
            "purpose": purpose,
            "task_set": score.set,
            "tasks": score.tasks,
            "solved": score.solved,
            "layouts": score.layouts.solved if score.layouts else "",
            "layouts_total": score.layouts.total if score.layouts else "",
            "length": "" if score.mean_steps is None else round(score.mean_steps, 4),
        }
        for score in scores
    ]


def is_last(row: Row, config: Config) -> bool:
    """Returns whether training ends with the iteration of this row."""
    if row["iteration"] >= config.iterations:
        return True
    if 0 < config.stop_when_solved <= row["evaluation"]:
        return True
    limit = config.max_transitions
    return limit is not None and row["transitions"] + config.longest_iteration > limit
