"""What the runs of an experiment come to: a record of plain values, for JSON and for tables.

Source: agent specification "Experiments"; paper section "Results".
"""

import dataclasses
import math
import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import trap_tube_jax as tt
from agents.runs.folder import CONFIG_FILE, Run, RunFolder, read_json
from agents.runs.metrics import FirstSolved, Optimality, Row, Score, read_metrics
from agents.runs.tracking import OVERALL, outcome

FOLDER_NAME = re.compile(r"(?P<algorithm>.+)-seed\d+(to\d+)?")

Lengths = Mapping[str, Sequence[int]]


class AlgorithmRun(NamedTuple):
    """A run of an experiment, as far as it got.

    Attributes:
      algorithm: its name.
      folder: its files.
      run: what it trains.
      rows: its rows of metrics.
    """

    algorithm: str
    folder: RunFolder
    run: Run
    rows: list[dict[str, float | int]]


def folder_name(algorithm: str, seeds: range) -> str:
    """The name of the folder of a run within that of its experiment."""
    last = f"to{seeds[-1]}" if len(seeds) > 1 else ""
    return f"{algorithm}-seed{seeds[0]}{last}"


def find_runs(root: Path) -> list[AlgorithmRun]:
    """All runs in the folder of an experiment, by algorithm and seed.

    Raises:
      ValueError: the settings of a run cannot be read.
    """
    found = []
    for path in root.glob(f"*/{CONFIG_FILE}"):
        match = FOLDER_NAME.fullmatch(path.parent.name)
        if match:
            folder, run = RunFolder.open(path.parent)
            rows = read_metrics(folder.metrics)
            found.append(AlgorithmRun(match["algorithm"], folder, run, rows))
    return sorted(found, key=lambda entry: (entry.algorithm, entry.run.seed))


def algorithm_record(
    algorithm: str, runs: Sequence[AlgorithmRun], shortest: Lengths | None
) -> dict[str, Any]:
    """Every seed of an algorithm and what they come to together.

    Args:
      algorithm: its name.
      runs: its runs; seeds without any iteration are left out.
      shortest: the lengths of each set's shortest plans, -1 where unsolvable, if known.
    """
    seeds = [
        seed_record(entry, seed, shortest)
        for entry in runs
        for seed in entry.run.seed_range
        if _of_seed(entry.rows, seed)
    ]
    return {
        "name": algorithm,
        "config": runs[0].run.config.to_dict(),
        "aggregate": aggregate(seeds),
        "runs": seeds,
    }


def seed_record(entry: AlgorithmRun, seed: int, shortest: Lengths | None) -> dict[str, Any]:
    """How far a seed got, when it solved its training set, and its best evaluation."""
    rows, config = _of_seed(entry.rows, seed), entry.run.config
    last = rows[-1]
    share = config.stop_when_solved or 1.0
    solved = next((row for row in rows if row["evaluation"] >= share), None)
    is_over = last["iteration"] >= config.iterations or (config.stop_when_solved > 0 and solved)
    summary = read_json(entry.folder.summary) or {}
    return {
        "seed": seed,
        "iterations": int(last["iteration"]),
        "of": config.iterations,
        "finished": bool(is_over),
        "episodes": int(last["episodes"]),
        "transitions": int(last["transitions"]),
        "training_seconds": round(float(last["seconds"]), 1),
        "compile_seconds": summary.get("compile_seconds"),
        "machines": read_json(entry.folder.machines) or [],
        "first_solved": None if solved is None else dataclasses.asdict(FirstSolved.of(solved)),
        "best": _best_record(entry, seed, rows, shortest),
    }


def best_row(rows: Sequence[Row]) -> Row | None:
    """The row of the best overall evaluation, the first of equals; None without evaluation."""
    evaluated = [row for row in rows if not math.isnan(row.get(OVERALL, math.nan))]
    return max(evaluated, key=lambda row: row[OVERALL], default=None)


def aggregate(seeds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means and deviations over seeds."""
    solved = [seed["first_solved"] for seed in seeds if seed["first_solved"]]
    best = [seed["best"] for seed in seeds if seed["best"]]
    by_set = zip(*(entry["sets"] for entry in best), strict=True)
    return {
        "trials": len(seeds),
        "solved": len(solved),
        "episodes_to_solve": mean_sd([first["episodes"] for first in solved]),
        "transitions": mean_sd([seed["transitions"] for seed in seeds]),
        "training_seconds": mean_sd([seed["training_seconds"] for seed in seeds]),
        "process_seconds": mean_sd([seed.get("process_seconds") for seed in seeds]),
        "overall": mean_sd([entry["overall"] for entry in best]),
        "sets": [_aggregate_set(scores) for scores in by_set],
    }


def mean_sd(values: Sequence[float | None]) -> dict[str, float | None] | None:
    """Mean and sample standard deviation of the known values; None without any."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {
        "mean": float(statistics.fmean(known)),
        "sd": float(statistics.stdev(known)) if len(known) > 1 else None,
    }


def _aggregate_set(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    compared = [score["optimality"] for score in scores if score["optimality"]]
    worst = [found["worst"] for found in compared if found["worst"] is not None]
    return {
        "set": scores[0]["set"],
        "label": scores[0]["label"],
        "tasks": scores[0]["tasks"],
        "percent": mean_sd([score["percent"] for score in scores]),
        "percent_of_solvable": mean_sd([found["percent_of_solvable"] for found in compared]),
        "optimality": mean_sd([found["mean"] for found in compared]),
        "worst": min(worst, default=None),
    }


def _best_record(
    entry: AlgorithmRun, seed: int, rows: Sequence[Row], shortest: Lengths | None
) -> dict[str, Any] | None:
    best = best_row(rows)
    if best is None:
        return None
    outcomes = _of_seed(read_metrics(entry.folder.outcomes), seed)
    played = [row for row in outcomes if row["iteration"] == best["iteration"]]
    if not played:
        where, which = entry.folder.outcomes, best["iteration"]
        raise ValueError(f"{where} lacks seed {seed}, iteration {which}, which the metrics have")
    scores = [
        _score(name, solved, steps, entry.run.config.max_steps, shortest)
        for name, (solved, steps) in outcome(played[0]).items()
    ]
    order = [task_set.short for task_set in tt.PAPER_TASK_SETS]
    scores.sort(key=lambda score: order.index(score.set))
    return {
        "iteration": int(best["iteration"]),
        "episodes": int(best["episodes"]),
        "overall": 100 * float(best[OVERALL]),
        "sets": [dataclasses.asdict(score) for score in scores],
    }


def _score(
    name: str, solved: np.ndarray, steps: np.ndarray, max_steps: int, shortest: Lengths | None
) -> Score:
    task_set = tt.task_set(name)
    optimality = None
    if shortest is not None and name in shortest:
        lengths = np.array(shortest[name][: len(steps)])
        optimality = Optimality.of(solved, steps, lengths, max_steps)
    is_sample = bool(task_set.transfers)
    return Score.of(name, task_set.label, solved, steps, is_sample=is_sample, optimality=optimality)


def _of_seed(rows: Sequence[Row], seed: int) -> list[Row]:
    return [row for row in rows if row["seed"] == seed]
