"""Results of runs as one tidy table."""

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from agents.runs.folder import CONFIG_FILE, RunFolder, read_json


def results(paths: str | Path | Iterable[str | Path]) -> pd.DataFrame:
    """Returns the evaluations of all runs in folders, one row each.

    Args:
      paths: one or several folders: of a run, or of runs at any depth.

    Returns:
      A data frame with a row for each run, seed, evaluated iteration, purpose of the tasks
      (validation or test) and task set. Columns: run, algorithm, preset, commit, the columns of
      `evaluations.csv` (seed, iteration, purpose, task_set, tasks, solved, layouts, layouts_total,
      length), and every setting.

    Raises:
      ValueError: a folder holds no run, or a file cannot be read.
    """
    tables = [_of_run(run) for run in find_runs(paths)]
    return pd.concat(tables, ignore_index=True)


def metrics(paths: str | Path | Iterable[str | Path]) -> pd.DataFrame:
    """Returns the training metrics of all runs in folders, one row per seed and iteration.

    Columns: run, algorithm, and those of `metrics.csv`. Arguments and errors as in `results`.
    """
    tables = []
    for folder in find_runs(paths):
        table, values = _read(folder.metrics), read_json(folder.config)
        table.insert(0, "run", str(folder.path))
        table.insert(1, "algorithm", values["algorithm"])
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def find_runs(paths: str | Path | Iterable[str | Path]) -> list[RunFolder]:
    """Returns the runs in folders, sorted by path.

    Raises:
      ValueError: a folder holds no run.
    """
    found: list[RunFolder] = []
    for path in map(Path, [paths] if isinstance(paths, str | Path) else paths):
        configs = sorted(path.rglob(CONFIG_FILE))
        if not configs:
            raise ValueError(f"{path} holds no run")
        found.extend(RunFolder(config.parent) for config in configs)
    return found


def _of_run(folder: RunFolder) -> pd.DataFrame:
    values = read_json(folder.config)  # plain values: no name in it is looked up or imported
    machines = read_json(folder.provenance) if folder.provenance.exists() else []
    table = _read(folder.evaluations)
    settings = {name: str(v) if isinstance(v, list) else v for name, v in values["config"].items()}
    first = {
        "run": str(folder.path),
        "algorithm": values["algorithm"],
        "preset": values["preset"],
        "commit": machines[-1]["commit"] if machines else None,
    }
    for place, (name, value) in enumerate(first.items()):
        table.insert(place, name, value)
    return table.assign(**settings)


def _read(path: Path) -> pd.DataFrame:
    if not path.exists() or not path.stat().st_size:
        return pd.DataFrame({"seed": [], "iteration": []})
    return pd.read_csv(path)
