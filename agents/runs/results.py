"""Any set of runs as one table of plain values."""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from agents.runs.folder import CONFIG_FILE, Run, RunFolder, is_done, read_json
from agents.runs.metrics import Row, first_solved, read_metrics

COSTS = ("episodes", "transitions", "seconds")


def results(paths: str | Path | Iterable[str | Path]) -> list[dict[str, Any]]:
    """One record per seed of all runs in folders, such as `pandas.DataFrame` takes.

    A record holds `run`, the run's folder; `preset`; `seed`; every setting by its name; and

        finished              whether the run is over
        trained_iterations    done so far; likewise trained_episodes, trained_transitions and
                              trained_seconds
        success, evaluation   the share of tasks solved last, in training and by greedy play
        solved_iterations     until greedy play first solved the training set (or the share
                              `stop_when_solved` of it); likewise solved_episodes,
                              solved_transitions and solved_seconds; None if it has not
        percent_<set>         of each set's tasks, percent solved once training was over; None
                              where training has gone on since

    Args:
      paths: a folder or several: of a run, or anything that holds runs, at any depth.

    Returns:
      The records, by folder and seed. What is not known yet is None.

    Raises:
      ValueError: there is no run in one of the folders, or it cannot be read.
    """
    given = [paths] if isinstance(paths, str | Path) else paths
    records = [record for path in given for record in _of_folder(Path(path))]
    names = list(dict.fromkeys(itertools.chain.from_iterable(records)))
    return [{name: record.get(name) for name in names} for record in records]


def _of_folder(path: Path) -> list[dict[str, Any]]:
    configs = sorted(path.rglob(CONFIG_FILE))
    runs = [file.parent for file in configs if not file.parent.name.startswith(".")]
    if not runs:
        raise ValueError(f"{path} holds no run")
    return [record for run in runs for record in _of_run(*RunFolder.open(run))]


def _of_run(folder: RunFolder, run: Run) -> list[dict[str, Any]]:
    rows, evaluated = read_metrics(folder.metrics), read_json(folder.evaluation) or []
    solved = first_solved(rows, run.seed_range, run.config.stop_when_solved)
    finished, records = is_done(folder, run), []
    for seed, first in zip(run.seed_range, solved, strict=True):
        last: Row = next((row for row in reversed(rows) if row["seed"] == seed), {})
        records.append(
            {
                "run": str(folder.path),
                "preset": run.preset,
                "seed": seed,
                **run.config.to_dict(),
                "finished": finished,
                "trained_iterations": last.get("iteration", 0),
                **{f"trained_{name}": last.get(name, 0) for name in COSTS},
                **{name: last.get(name) for name in ("success", "evaluation")},
                "solved_iterations": first and first.iteration,
                **{f"solved_{name}": first and getattr(first, name) for name in COSTS},
                **_percents(evaluated, seed, last.get("iteration", 0)),
            }
        )
    return records


def _percents(
    evaluated: list[dict[str, Any]], seed: int, iteration: float
) -> dict[str, float | None]:
    """Those of a seed's evaluation; None where training has gone on since."""
    return {
        f"percent_{score['set']}": score["percent"] if entry["iteration"] == iteration else None
        for entry in evaluated
        if entry["policy"] == f"seed {seed}"
        for score in entry["sets"]
    }
