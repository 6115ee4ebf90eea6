"""CSV files that a run appends to."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.config import Config
from agents.files import write_text

Row = Mapping[str, Any]


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


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Writes one or more rows of the same columns to a CSV file, atomically."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def read_rows(path: Path) -> list[Row]:
    """Reads the rows of a CSV file, numbers parsed; none if it is missing.

    A torn last line, which a killed process leaves, is dropped.

    Raises:
      ValueError: the file has no column `iteration`.
    """
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    reader = csv.DictReader(line for line in text.splitlines(True) if line.endswith("\n"))
    if text and "iteration" not in (reader.fieldnames or ()):
        raise ValueError(f"{path} has no header with a column 'iteration'; delete or restore it")
    whole = [row for row in reader if None not in row and None not in row.values()]
    return [{name: _parse(value) for name, value in row.items()} for row in whole]


def rewind_rows(path: Path, iteration: int) -> list[Row]:
    """Deletes the rows after an iteration from a CSV file; returns the others."""
    rows = [row for row in read_rows(path) if row["iteration"] <= iteration]
    if rows:
        write_rows(path, rows)
    else:
        path.unlink(missing_ok=True)
    return rows


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
