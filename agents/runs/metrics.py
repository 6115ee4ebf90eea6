"""CSV files of rows: the metrics of a run's iterations, and its evaluations."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

import trap_tube_jax as tt
from agents.acting.policy import Policy
from agents.config import Config
from agents.files import append_text, naming_file, write_bytes
from trap_tube_jax.scoring.tasks import Purpose

Row = Mapping[str, Any]
Table = Any  # pandas.DataFrame; what a type checker infers of pandas is too wide to use

METRICS: dict[str, Any] = {
    "iteration": int,
    "episodes": int,
    "transitions": int,
    "seconds": float,
    "validation_success": float,
}
EVALUATIONS: dict[str, Any] = {
    "iteration": int,
    "purpose": str,
    "task_set": str,
    "tasks": int,
    "solved": int,
    "layouts": float,
    "layouts_total": float,
}
OF_A_RUN = {"algorithm": str, "seed": int}
COLUMNS = {  # that a file must have, by its name, and their types
    "metrics.csv": METRICS,
    "evaluations.csv": EVALUATIONS,
    # Older records do not count transitions.
    "curves.csv": {**OF_A_RUN, **METRICS, "transitions": float, "success": float},
    "results.csv": {**OF_A_RUN, **EVALUATIONS},
}


def append_rows(path: Path, rows: Sequence[Row]) -> None:
    """Appends rows, if any, to a CSV file; begins a new file with a header.

    Raises:
      ValueError: the rows have other columns than the file.
      OSError: the file cannot be written.
    """
    if not rows:
        return
    table = pd.DataFrame(rows)
    lines = table.to_csv(index=False, header=False)
    append_text(path, lines, head=table[:0].to_csv(index=False))


def write_rows(path: Path, table: Table) -> None:
    """Writes a table as a CSV file, atomically."""
    write_bytes(path, table.to_csv(index=False).encode())


def read_rows(path: Path) -> Table:
    """Reads a CSV file with the `COLUMNS` of its name; an empty table if the file is missing.

    Ignores an incomplete last line, which a killed process leaves.

    Raises:
      ValueError: the file is damaged; the message names it.
      OSError: the file cannot be opened.
    """
    columns = COLUMNS[path.name]
    text = "".join(_complete_lines(path)) or ",".join(columns)
    with naming_file(path):
        # Without `index_col`, a longer first row would make its first value an index.
        table: Table = pd.read_csv(
            io.StringIO(text),
            dtype=columns,
            index_col=False,
            keep_default_na=False,  # "NA" may name a task set
            na_values=[""],
        )
        if missing := [name for name in columns if name not in table]:
            raise ValueError(f"it has no column {', '.join(missing)}")
    return table


def rewind_rows(path: Path, iteration: int) -> None:
    """Removes the rows after an iteration, from whose checkpoint training makes them again.

    Raises ValueError, and leaves the file as it is, if it is damaged.
    """
    if not path.is_file():
        return
    header, *lines = _complete_lines(path) or [""]
    iterations = read_rows(path)["iteration"]
    kept = [line for line, done in zip(lines, iterations, strict=True) if done <= iteration]
    content = "".join([header, *kept]) if kept else ""
    write_bytes(path, content.encode())


def _complete_lines(path: Path) -> list[str]:
    """Returns the lines of a file that end in a newline, without blank ones."""
    if not path.is_file():
        return []
    with naming_file(path):
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [line for line in lines if line.endswith("\n") and line.strip()]


def evaluation_rows(scores: tt.Scores, policy: Policy, purpose: Purpose) -> list[Row]:
    """Returns the rows of `evaluations.csv` for the scores of a policy.

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
        for score in scores.sets
    ]


def is_last(row: Row, config: Config) -> bool:
    """Returns whether training ends with the iteration of this row."""
    if row["iteration"] >= config.iterations:
        return True
    if 0 < config.stop_when_solved <= row["validation_success"]:
        return True
    limit = config.max_transitions
    longest = config.episodes_per_iteration * config.step_limit
    return limit is not None and row["transitions"] + longest > limit
