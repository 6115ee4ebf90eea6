"""Results of runs as one tidy table."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from agents.runs.folder import CONFIG_FILE, RunFolder, runs_near
from agents.runs.metrics import read_rows
from agents.runs.provenance import read_provenance
from trap_tube_jax.checks import expand

Paths = str | Path | Iterable[str | Path]


def results(paths: Paths) -> pd.DataFrame:
    """Returns the evaluations of all runs in folders as a tidy table.

    Args:
      paths: one or several folders: of a run, or of runs at any depth; `~` is the home folder.

    Returns:
      A data frame with a row for each run, evaluated iteration, purpose of the tasks (validation
      or test) and task set. Columns: run, algorithm, seed, finetune (the agent that training
      started from, or ""), commit, the columns of `evaluations.csv` (iteration, purpose, task_set,
      tasks, solved, layouts, layouts_total, length), and every setting.

    Raises:
      ValueError: a folder holds no run, or a file is damaged.
      OSError: a file or folder cannot be opened.

    Example:
      >>> config = agents.Config.preset("fast", iterations=1, episodes_per_iteration=32)
      >>> options = agents.RunOptions(sets=("base",), report=False)
      >>> scores = agents.train_run("runs/mine", agents.Run(config, seed=3), options)
      >>> table = agents.results("runs")
      >>> table.seed.unique().tolist(), table.task_set.unique().tolist()
      ([3], ['base'])
    """
    tables = []
    for folder in find_runs(paths):
        machines = read_provenance(folder.provenance)
        commit = machines[-1]["commit"] if machines else None
        stored = folder.stored()
        origin = stored.get("finetune") or ""
        table = _table(folder, folder.evaluations, stored, finetune=origin, commit=commit)
        settings = stored["config"].items()
        tables.append(table.assign(**{k: str(v) if type(v) is list else v for k, v in settings}))
    return _join(tables)


def metrics(paths: Paths) -> pd.DataFrame:
    """Returns the training metrics of all runs in folders, one row per run and iteration.

    Columns: run, algorithm, seed, and the columns of `metrics.csv`. Arguments and errors as in
    `results`.
    """
    return _join([_table(run, run.metrics, run.stored()) for run in find_runs(paths)])


def find_runs(paths: Paths) -> list[RunFolder]:
    """Returns the runs in folders, sorted by path, once even if several links lead to one.

    Raises:
      ValueError: a folder holds no run, or there is no folder.
      OSError: a folder cannot be opened.
    """
    found: dict[str, Path] = {}
    for path in map(expand, [paths] if isinstance(paths, str | Path) else paths):
        runs = sorted(runs_below(path))
        if not runs:
            raise ValueError(f"{path} holds no run; {runs_near(path)}")
        for run in runs:
            found.setdefault(os.path.realpath(run), run)
    if not found:
        raise ValueError("paths must name at least one folder")
    return list(map(RunFolder, found.values()))


def runs_below(path: Path) -> Iterable[Path]:
    """Yields the folders of the runs in a folder, once even if several links lead to one."""
    seen = set()
    for folder, names, files in os.walk(path, onerror=_raise, followlinks=True):
        names.sort(key=lambda name: (Path(folder, name).is_symlink(), name))
        if os.path.realpath(folder) in seen:
            names.clear()
        elif CONFIG_FILE in files:
            yield Path(folder)
        seen.add(os.path.realpath(folder))


def _raise(error: OSError) -> None:
    if not isinstance(error, FileNotFoundError | NotADirectoryError):  # deleted, or never there
        raise error


def _table(folder: RunFolder, path: Path, stored: dict[str, Any], **about: Any) -> pd.DataFrame:
    rows = read_rows(path)
    names = ("algorithm", "seed")
    first = {"run": str(folder.path), **{name: stored[name] for name in names}, **about}
    return rows.assign(**first)[[*first, *rows]]


def _join(tables: list[pd.DataFrame]) -> pd.DataFrame:
    known = [table for table in tables if len(table)]  # an empty one has no types
    return pd.concat(known or tables, ignore_index=True)
