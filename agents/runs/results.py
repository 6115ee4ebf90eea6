"""Results of runs as one tidy table."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from agents.files import read_json
from agents.runs.folder import CONFIG_FILE, RunFolder
from agents.runs.metrics import read_rows

Paths = str | Path | Iterable[str | Path]


def results(paths: Paths) -> pd.DataFrame:
    """Returns the evaluations of all runs in folders, one row each.

    Args:
      paths: one or several folders: of a run, or of runs at any depth.

    Returns:
      A data frame with a row for each run, evaluated iteration, purpose of the tasks (validation
      or test) and task set. Columns: run, algorithm, seed, commit, the columns of
      `evaluations.csv` (iteration, purpose, task_set, tasks, solved, layouts, layouts_total,
      length), and every setting.

    Raises:
      ValueError: a folder holds no run, or a file cannot be read.
    """
    tables = []
    for folder in find_runs(paths):
        machines = read_json(folder.provenance) if folder.provenance.exists() else []
        commit = machines[-1]["commit"] if machines else None
        table = _table(folder, folder.evaluations, commit=commit)
        settings = read_json(folder.config)["config"].items()
        tables.append(table.assign(**{k: str(v) if type(v) is list else v for k, v in settings}))
    return _join(tables)


def metrics(paths: Paths) -> pd.DataFrame:
    """Returns the training metrics of all runs in folders, one row per run and iteration.

    Columns: run, algorithm, seed, and those of `metrics.csv`. Arguments and errors as in `results`.
    """
    return _join([_table(folder, folder.metrics) for folder in find_runs(paths)])


def find_runs(paths: Paths) -> list[RunFolder]:
    """Returns the runs in folders, sorted by path; ValueError for a folder without."""
    found: list[RunFolder] = []
    for path in map(Path, [paths] if isinstance(paths, str | Path) else paths):
        walk = os.walk(path, followlinks=True)  # unlike `rglob`, passes over deleted folders
        runs = sorted(Path(folder) for folder, _, files in walk if CONFIG_FILE in files)
        if not runs:
            raise ValueError(f"{path} holds no run")
        found.extend(map(RunFolder, runs))
    return found


def _table(folder: RunFolder, path: Path, **about: Any) -> pd.DataFrame:
    run = read_json(folder.config)  # plain values: no name in it is looked up or imported
    rows, names = read_rows(path), ("algorithm", "seed")
    first = {"run": str(folder.path), **{name: run[name] for name in names}, **about}
    return rows.assign(**first)[[*first, *rows]]


def _join(tables: list[pd.DataFrame]) -> pd.DataFrame:
    known = [table for table in tables if len(table)]  # an empty one has no types
    return pd.concat(known or tables, ignore_index=True)
