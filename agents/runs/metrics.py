"""CSV files that a run appends to."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from agents.acting.policy import Policy
from agents.config import Config
from agents.files import write_bytes
from trap_tube_jax.scoring.scores import Scores
from trap_tube_jax.scoring.tasks import Purpose

Row = Mapping[str, Any]
NO_ROWS = "iteration,purpose,task_set,tasks,solved,validation_success,episodes\n"
Frame = Any  # pandas.DataFrame; what a type checker infers of pandas is too wide to use


def append_rows(path: Path, rows: Sequence[Row]) -> None:
    """Appends rows to a CSV file; begins a new file with a header.

    Raises:
      ValueError: the rows have other columns than the file.
      OSError: the file cannot be written.
    """
    frame, is_new = pd.DataFrame(rows), not path.exists()
    if not is_new and list(pd.read_csv(path, nrows=0)) != list(frame):
        raise ValueError(f"{path} has other columns than {', '.join(frame)}; move it away")
    frame.to_csv(path, mode="a", header=is_new, index=False)


def read_rows(path: Path, **options: Any) -> Frame:
    """Reads a CSV file of a run; drops a last line that a killed process left incomplete.

    Returns an empty table if the file is missing. Passes `options` to `pandas.read_csv`.
    """
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return pd.read_csv(io.StringIO(text[: text.rfind("\n") + 1] or NO_ROWS), **options)


def rewind_rows(path: Path, iteration: int) -> None:
    """Deletes the rows after an iteration; ValueError if the file has no column `iteration`."""
    rows = read_rows(path, dtype=str, keep_default_na=False)
    if "iteration" not in rows:
        raise ValueError(f"{path} has no column 'iteration'; delete or restore it")
    kept = rows[rows["iteration"].astype(int) <= iteration]
    if len(kept):
        write_bytes(path, kept.to_csv(index=False).encode())
    else:
        path.unlink(missing_ok=True)


def evaluation_rows(scores: Scores, policy: Policy, purpose: Purpose) -> list[Row]:
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
        for score in scores.sets
    ]


def is_last(row: Row, config: Config) -> bool:
    """Returns whether training ends with the iteration of this row."""
    if row["iteration"] >= config.iterations:
        return True
    if 0 < config.stop_when_solved <= row["validation_success"]:
        return True
    limit = config.max_transitions
    longest = config.episodes_per_iteration * config.step_limit(config.env_id)
    return limit is not None and row["transitions"] + longest > limit
