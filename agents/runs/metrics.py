"""Numbers of a run on the host: the CSV file, scores of task sets, when it was solved."""

import csv
import dataclasses
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Row = Mapping[str, float | int]

LEADING_COLUMNS = ("seed", "iteration", "episodes", "transitions")
TIMING_COLUMNS = ("seconds", "transitions_per_second")
NORMAL_QUANTILE_95 = 1.959963984540054


class MetricsLog:
    """A CSV file with a row per seed and iteration, on disk as soon as it is written."""

    def __init__(self, path: Path, *, last_iteration: int = 0):
        """Opens the file, without the rows of any iteration after `last_iteration`.

        Args:
          path: made on the first `append`.
          last_iteration: what training continues from; 0 starts anew.
        """
        self._path = path
        rows = [row for row in read_metrics(path) if row["iteration"] <= last_iteration]
        self.rows: list[Row] = []
        self._columns: list[str] = []
        draft = path.with_name(f".{path.name}.{os.getpid()}")
        with draft.open("w", newline="") as file:
            self._write(file, rows)
        draft.replace(path)

    def append(self, rows: Sequence[Row]) -> None:
        """Adds the rows of one iteration."""
        with self._path.open("a", newline="") as file:
            self._write(file, rows)

    def _write(self, file: Any, rows: Sequence[Row]) -> None:
        writer = csv.writer(file, lineterminator="\n")
        if rows and not self._columns:
            self._columns = _columns(rows[0])
            writer.writerow(self._columns)
        writer.writerows([_text(row.get(name, math.nan)) for name in self._columns] for row in rows)
        self.rows.extend(rows)


def read_metrics(path: Path) -> list[dict[str, float | int]]:
    """The rows of a metrics file; none if it is missing. A torn last line is left out."""
    if not path.exists():
        return []
    whole = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
    return [
        {name: _number(text) for name, text in row.items()}
        for row in csv.DictReader(whole)
        if None not in row and None not in row.values()
    ]


@dataclasses.dataclass(frozen=True)
class FirstSolved:
    """When the greedy policy first solved what it trains on.

    Attributes:
      iteration: iterations done by then.
      episodes: episodes played by then.
      transitions: environment steps taken by then.
      seconds: seconds of training by then, compilation excluded.
    """

    iteration: int
    episodes: int
    transitions: int
    seconds: float

    @classmethod
    def of(cls, row: Row) -> "FirstSolved":
        """That of a row of metrics."""
        return cls(
            iteration=int(row["iteration"]),
            episodes=int(row["episodes"]),
            transitions=int(row["transitions"]),
            seconds=round(float(row["seconds"]), 3),
        )


@dataclasses.dataclass(frozen=True)
class Optimality:
    """How the solved episodes compare with shortest plans.

    Attributes:
      solvable: tasks that any sequence of actions within the step limit solves.
      percent_of_solvable: of those, percent solved; None if there are none.
      mean: mean of shortest length / steps taken over solved tasks; None if there are none.
      worst: the smallest of them.
    """

    solvable: int
    percent_of_solvable: float | None
    mean: float | None
    worst: float | None

    @classmethod
    def of(
        cls, solved: np.ndarray, length: np.ndarray, shortest: np.ndarray, max_steps: int
    ) -> "Optimality":
        """Compares bool[B] and i32[B] with shortest lengths i32[B], -1 where unsolvable."""
        solvable = (shortest >= 0) & (shortest <= max_steps)
        ratio = shortest[solved] / np.maximum(length[solved], 1)
        return cls(
            solvable=int(solvable.sum()),
            percent_of_solvable=100 * float(solved[solvable].mean()) if solvable.any() else None,
            mean=float(ratio.mean()) if len(ratio) else None,
            worst=float(ratio.min()) if len(ratio) else None,
        )


@dataclasses.dataclass(frozen=True)
class Score:
    """Greedy play on the fixed tasks of one set.

    Attributes:
      set: the set's short name.
      label: its name in the paper's notation.
      tasks: how many tasks were tried.
      solved: how many were solved.
      percent: 100 solved / tasks.
      interval: 95 % Wilson interval of the percentage over the set's tasks; None where
        the one task tried is all there is, so that nothing is estimated.
      mean_steps: mean steps of the solved episodes; None without any.
      optimality: the comparison with shortest plans, if one was made.
    """

    set: str
    label: str
    tasks: int
    solved: int
    percent: float
    interval: tuple[float, float] | None
    mean_steps: float | None
    optimality: Optimality | None = None

    @classmethod
    def of(
        cls,
        name: str,
        label: str,
        solved: np.ndarray,
        length: np.ndarray,
        *,
        is_sample: bool,
        optimality: Optimality | None = None,
    ) -> "Score":
        """The score of outcomes bool[B] and lengths i32[B]; `is_sample`: there are more tasks."""
        count, tasks = int(np.sum(solved)), len(solved)
        low, high = wilson_interval(count, tasks)
        return cls(
            set=name,
            label=label,
            tasks=tasks,
            solved=count,
            percent=100 * count / tasks,
            interval=(100 * low, 100 * high) if is_sample else None,
            mean_steps=float(np.mean(length[solved])) if count else None,
            optimality=optimality,
        )


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """The 95 % score interval of a probability (Wilson, 1927).

      (p + z^2 / 2n ± z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n),  p = successes / n.

    Raises:
      ValueError: there is no trial, or not 0 <= successes <= trials.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"need 0 <= successes <= trials >= 1, got {successes} and {trials}")
    z2 = NORMAL_QUANTILE_95**2
    share = successes / trials
    center = share + z2 / (2 * trials)
    margin = math.sqrt(z2 * (share * (1 - share) / trials + z2 / (4 * trials**2)))
    scale = 1 + z2 / trials
    return max(0.0, (center - margin) / scale), min(1.0, (center + margin) / scale)


def _columns(row: Row) -> list[str]:
    inner = sorted(set(row) - {*LEADING_COLUMNS, *TIMING_COLUMNS})
    return [
        *(name for name in LEADING_COLUMNS if name in row),
        *inner,
        *(name for name in TIMING_COLUMNS if name in row),
    ]


def _text(value: float | int) -> str:
    """The shortest text that reads back as the same number."""
    return str(value)


def _number(text: str) -> float | int:
    try:
        return int(text)
    except ValueError:
        return float(text)


def column(rows: Iterable[Row], name: str) -> np.ndarray:
    """The values f64[n] of one column."""
    return np.array([row[name] for row in rows], np.float64)
