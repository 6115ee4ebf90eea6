"""The metrics of a run on the host: the CSV file, and when a seed first solved its tasks."""

import csv
import dataclasses
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.config import Config

Row = Mapping[str, float | int]


class MetricsLog:
    """A CSV file with a row per seed and iteration, on disk as soon as it is written."""

    def __init__(self, path: Path, *, last_iteration: int = 0):
        """Opens the file, without the rows of any iteration after `last_iteration`.

        Args:
          path: made at once, empty if there are no rows.
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
            self._columns = list(rows[0])
            writer.writerow(self._columns)
        writer.writerows([row.get(name, math.nan) for name in self._columns] for row in rows)
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


def first_solved(
    rows: Iterable[Row], seeds: Iterable[int], stop_when_solved: float
) -> tuple[FirstSolved | None, ...]:
    """When each seed first solved enough of what it trains on, if it has.

    Args:
      rows: of metrics, in order of time.
      seeds: which seeds.
      stop_when_solved: the share of the tasks that is enough; 0 stands for all of them.
    """
    share = stop_when_solved or 1.0
    found: dict[int, Row] = {}
    for row in rows:
        if row["evaluation"] >= share:
            found.setdefault(int(row["seed"]), row)
    return tuple(FirstSolved.of(found[seed]) if seed in found else None for seed in seeds)


def is_last(row: Row, config: Config) -> bool:
    """Whether a seed trains no more after the iteration of this row."""
    if row["iteration"] >= config.iterations:
        return True
    if config.stop_when_solved > 0 and row["evaluation"] >= config.stop_when_solved:
        return True
    limit = config.max_transitions
    return limit is not None and int(row["transitions"]) + config.longest_iteration > limit


def _number(text: str) -> float | int:
    try:
        return int(text)
    except ValueError:
        return float(text)
