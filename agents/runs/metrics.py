"""CSV files that a run appends to."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.config import Config
from agents.runs.folder import write_text

Row = Mapping[str, Any]


class CsvLog:
    """A CSV file that grows by rows, each on disk as soon as it is appended.

    Attributes:
      rows: all rows.
    """

    def __init__(self, path: Path, *, last_iteration: int = 0):
        """Opens the file, made at the first row if missing; drops rows after `last_iteration`."""
        self._path = path
        rows = read_rows(path)
        self.rows: list[Row] = [row for row in rows if row["iteration"] <= last_iteration]
        if rows:
            write_text(path, self._text(self.rows, header=True))

    def append(self, rows: Sequence[Row]) -> None:
        """Appends rows of the columns of the first row.

        Raises:
          ValueError: a row has a further column.
          OSError: the file cannot be written.
        """
        self.rows.extend(rows)
        with self._path.open("a", newline="", encoding="utf-8") as file:
            file.write(self._text(rows, header=not file.tell()))

    def _text(self, rows: Sequence[Row], *, header: bool) -> str:
        text = io.StringIO()
        if self.rows:
            writer = csv.DictWriter(text, list(self.rows[0]), lineterminator="\n")
            if header:
                writer.writeheader()
            writer.writerows(rows)
        return text.getvalue()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Reads the rows of a CSV file, numbers parsed; none if it is missing.

    A torn last line, which a killed process leaves, is dropped.

    Raises:
      ValueError: the file has no column `iteration`.
    """
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    reader = csv.DictReader(line for line in lines if line.endswith("\n"))
    if lines and "iteration" not in (reader.fieldnames or ()):
        raise ValueError(f"{path} has no header with a column 'iteration'; delete or restore it")
    whole = [row for row in reader if None not in row and None not in row.values()]
    return [{name: _parse(text) for name, text in row.items()} for row in whole]


def is_last(row: Row, config: Config) -> bool:
    """Returns whether a seed trains no more after the iteration of this row."""
    if row["iteration"] >= config.iterations:
        return True
    if 0 < config.stop_when_solved <= row["evaluation"]:
        return True
    limit = config.max_transitions
    return limit is not None and int(row["transitions"]) + config.longest_iteration > limit


def _parse(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
