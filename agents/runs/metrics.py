"""CSV files of rows: the metrics of a run's iterations, and its evaluations."""

import csv
import dataclasses
import io
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import pandas as pd

import trap_tube_jax as tt
from agents.acting.policy import Policy
from agents.config import Config
from agents.files import append_text, is_file, naming_file, read_text, write_bytes
from agents.runs.run import check_algorithm
from trap_tube_jax.checks import check_stored_name
from trap_tube_jax.scoring.tasks import Purpose

Row = Mapping[str, Any]
Table = Any  # pandas.DataFrame; what a type checker infers of pandas is too wide to use


def _purpose(value: str) -> str:
    if value not in get_args(Purpose):
        raise ValueError(f"not {' or '.join(get_args(Purpose))}")
    return value


def _algorithm(value: str) -> str:
    check_algorithm(value)
    return value


def _text(value: str) -> str:
    if not value.isprintable():
        raise ValueError("not printable")
    return value


def _name(value: str) -> str:
    check_stored_name("task set", value)
    return value


def _count(value: str) -> int:
    if not re.fullmatch("[0-9]{1,15}", value):
        raise ValueError("not a count")
    return int(value)


def _positive(value: str) -> int:
    if not _count(value):
        raise ValueError("not positive")
    return int(value)


def _number(value: str) -> float:
    number = float(value or "nan")
    if value and not math.isfinite(number):
        raise ValueError("not finite")
    return number


@dataclasses.dataclass(frozen=True)
class Schema:
    """The columns of a CSV file.

    Attributes:
      columns: a parser for the values of every required column.
      other: a parser for the values of all other columns.
    """

    columns: Mapping[str, Callable[[str], Any]]
    other: Callable[[str], Any] = _number


COSTS = {"iteration": _count, "episodes": _count, "transitions": _count, "seconds": _number}
METRICS = {**COSTS, "validation_success": _number}
EVALUATIONS = {
    "iteration": _count,
    "purpose": _purpose,
    "task_set": _name,
    "tasks": _positive,
    "solved": _count,
    "layouts": _number,
    "layouts_total": _number,
}
OF_A_RUN = {"algorithm": _algorithm, "seed": _count}
SCHEMAS = {  # by the name of the file
    "metrics.csv": Schema(METRICS),
    "evaluations.csv": Schema(EVALUATIONS),
    # Older records do not count transitions.
    "curves.csv": Schema({**OF_A_RUN, **METRICS, "transitions": _number, "success": _number}),
    "results.csv": Schema({**OF_A_RUN, **EVALUATIONS}, _text),
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
    """Reads a CSV file by the schema of its name; an empty table if the file is missing.

    Ignores an incomplete last line, which a killed process leaves.

    Raises:
      ValueError: the file is damaged; the message names it.
      OSError: the file cannot be opened.
    """
    return _table(path, _records(path))


def _table(path: Path, records: list[list[str]]) -> Table:
    header, *rows = records
    schema = SCHEMAS[path.name]
    parsers = [schema.columns.get(name, schema.other) for name in header]
    with naming_file(path):
        for name in schema.columns:
            if name not in header:
                raise ValueError(f"it has no column {name!r}")
        columns = zip(*rows, strict=True) if rows else [[] for _ in header]
        table = {
            name: [_parsed(parse, value, name) for value in values]
            for name, parse, values in zip(header, parsers, columns, strict=True)
        }
        if "solved" in table and any(map(operator.gt, table["solved"], table["tasks"])):
            raise ValueError("more tasks are solved than there are")
        return pd.DataFrame(table, columns=header)


def _records(path: Path) -> list[list[str]]:
    """Reads the header and the complete rows of a CSV file; only a header if it is missing."""
    text = read_text(path) if is_file(path) else ""
    if "\n" not in text:  # not even the header is complete
        return [list(SCHEMAS[path.name].columns)]
    with naming_file(path):
        header, *rows = filter(None, csv.reader(io.StringIO(text, newline=""), strict=True))
        if rows and not text.endswith("\n") and len(rows[-1]) < len(header):
            rows.pop()
        if len(set(header)) < len(header) or not all(map(_is_name, header)):
            raise ValueError("its columns must have different, printable names")
        for number, row in enumerate(rows, 1):
            if len(row) != len(header):
                raise ValueError(f"row {number} has {len(row)} values for {len(header)} columns")
        return [header, *rows]


def _is_name(text: str) -> bool:
    return text != "" and text.isprintable()


def _parsed(parse: Callable[[str], Any], value: str, name: str) -> Any:
    try:
        return parse(value)
    except ValueError as error:
        raise ValueError(f"{name} cannot be {value[:40]!r}: {error}") from error


def check_row(row: Row) -> None:
    """Raises ValueError unless a row of metrics has the values that training goes on from."""
    for name, parse in METRICS.items():
        if name not in row:
            raise ValueError(f"it has no {name!r}")
        _parsed(parse, str(row[name]), name)


def rewind_rows(path: Path, iteration: int) -> None:
    """Removes the rows after an iteration, from whose checkpoint training makes them again.

    Raises ValueError, and leaves the file as it is, if it is damaged.
    """
    records = _records(path)
    table = _table(path, records)
    kept = [
        row for row, done in zip(records[1:], table["iteration"], strict=True) if done <= iteration
    ]
    file = io.StringIO(newline="")
    if kept:
        csv.writer(file, lineterminator="\n").writerows([records[0], *kept])
    if is_file(path) and file.getvalue() != read_text(path):
        write_bytes(path, file.getvalue().encode())


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
