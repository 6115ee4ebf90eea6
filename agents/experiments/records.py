"""Records: what an experiment came to, in one JSON file from which all is drawn.

A record holds what was measured and nothing derived from it: the command, the machines with
their versions and commits, and for every seed its learning curves and the steps that its best
policy took in each reported task. Tables and figures are functions of a record alone.

    schema      the name of this layout; a file of another one is refused
    experiment  `exp1` or `exp2`
    command     what to type for the same runs
    protocol    the settings of the experiment
    ranked      the sets whose mean chose the best evaluation
    machines    hardware, versions and commit of every process that trained, and how many devices
                shared its run
    sets        by set: `max_steps`, its step limit; `equal_to_base`, percent of the reported
                tasks that equal the base task; `layout`, the layout of each task, where the
                set has few; `shortest`, the lengths of the first tasks' shortest plans, -1
                where unsolvable
    algorithms  by algorithm: its name, its settings, and its runs, one per seed
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.experiments.training import AlgorithmRun
from agents.runs.folder import read_json
from agents.runs.machine import DIRTY, machine
from agents.runs.metrics import Row, first_solved, is_last
from agents.runs.tracking import GREEDY, OVERALL

SCHEMA = "trap-tube-jax experiment 1"
MAX_POINTS = 200  # of a curve
DIGITS = 4  # significant digits of a curve's values

Record = Mapping[str, Any]
Steps = Mapping[str, Sequence[int] | np.ndarray]


def seed_record(
    entry: AlgorithmRun,
    seed: int,
    *,
    machines: list[Any],
    evaluate_every: int,
    steps: Steps | None,
) -> dict[str, Any]:
    """What one seed came to.

    Args:
      entry: its run.
      seed: which one.
      machines: those of the record so far; this run's are added to them.
      evaluate_every: iterations from one evaluation on all sets to the next.
      steps: by set, the steps that its best policy took in each reported task, 0 where it
        did not solve it; None if it has not been evaluated yet.
    """
    rows, config = of_seed(entry.rows, seed), entry.run.config
    last = rows[-1]
    (solved,) = first_solved(rows, [seed], config.stop_when_solved)
    summary = read_json(entry.folder.summary) or {}
    used = read_json(entry.folder.machines) or []
    machines.extend(each for each in used if each not in machines)
    best = best_row(rows)
    return {
        "seed": seed,
        "iterations": int(last["iteration"]),
        "of": config.iterations,
        "finished": bool(is_last(last, config)),
        "episodes": int(last["episodes"]),
        "transitions": int(last["transitions"]),
        "training_seconds": round(float(last["seconds"]), 1),
        "compile_seconds": summary.get("compile_seconds"),
        "machines": [machines.index(each) for each in used],
        "first_solved": solved and dataclasses.asdict(solved),
        "best": None if best is None else _best(best, steps),
        "curves": curves(rows, config.iterations, evaluate_every),
    }


def _best(row: Row, steps: Steps | None) -> dict[str, Any]:
    return {
        "iteration": int(row["iteration"]),
        "episodes": int(row["episodes"]),
        "selected_percent": 100 * float(row[OVERALL]),
        "steps": steps and {name: list(map(int, taken)) for name, taken in steps.items()},
    }


def best_row(rows: Sequence[Row]) -> Row | None:
    """The row of the best overall evaluation, the first of equals; None without evaluation."""
    return max(_evaluated(rows), key=lambda row: row[OVERALL], default=None)


def curves(
    rows: Sequence[Row], total: int, evaluate_every: int
) -> dict[str, dict[str, list[float]]]:
    """A seed's learning curves as columns, thinned to about `MAX_POINTS` points.

    Args:
      rows: its metrics.
      total: the iterations it trains for; with these, all seeds keep the same points.
      evaluate_every: iterations from one evaluation on all sets to the next.

    Returns:
      `training`: of training; `greedy`: of the evaluations on all sets; both thinned.
    """
    evaluated = _evaluated(rows)
    names = [name for name in (evaluated or rows)[0] if name.startswith(GREEDY)]
    return {
        "training": _columns(_thinned(rows, total, 1), ("success", "evaluation")),
        "greedy": _columns(_thinned(evaluated, total, evaluate_every), names),
    }


def rows_of(run: Record) -> list[Row]:
    """The rows of metrics that a seed's curves hold; the inverse of `curves`."""
    rows: list[Row] = []
    for columns in run["curves"].values():
        made = [
            dict(zip(columns, values, strict=True))
            for values in zip(*columns.values(), strict=True)
        ]
        rows += [{"seed": run["seed"], **row} for row in made]
    return rows


def of_seed(rows: Iterable[Row], seed: int) -> list[Row]:
    """The rows of one seed."""
    return [row for row in rows if row["seed"] == seed]


def check_clean(record: Record, commit: str | None = None) -> None:
    """Checks that a record is of committed code.

    Args:
      record: what is to be written.
      commit: that of the code that writes it, where git does not tell it.

    Raises:
      ValueError: the work tree is dirty, or was where a run was trained, or git is absent
        and no commit was given.
    """
    commits = {entry["commit"] for entry in record["machines"]} | {machine()["commit"] or commit}
    if None in commits:
        raise ValueError(
            "a record names its commit, which git does not tell; run in a clone, or give --commit"
        )
    dirty = sorted(str(commit) for commit in commits if str(commit).endswith(DIRTY))
    if dirty:
        raise ValueError(
            f"a record is of committed code, this one of {', '.join(dirty)}; commit the changes "
            "and run the experiment again"
        )


def read_record(path: Path, *schemas: str) -> Record:
    """The record in a file.

    Args:
      path: the file.
      schemas: those allowed; that of an experiment if none is given.

    Raises:
      ValueError: it is none, or of another schema.
    """
    record = read_json(path)
    if not isinstance(record, dict) or "schema" not in record:
        raise ValueError(f"{path} is no record: it has no schema")
    schemas = schemas or (SCHEMA,)
    if record["schema"] not in schemas:
        allowed = ", ".join(map(repr, schemas))
        raise ValueError(f"{path} is of schema {record['schema']!r}; allowed: {allowed}")
    return record


def _evaluated(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if not math.isnan(row.get(OVERALL, math.nan))]


def _thinned(rows: Sequence[Row], total: int, step: int) -> list[Row]:
    """The rows whose iterations are multiples of one multiple of `step`, and the last row."""
    every = step * -(-total // (step * MAX_POINTS))
    return [row for row in rows if row["iteration"] % every == 0 or row is rows[-1]]


def _columns(rows: Sequence[Row], names: Sequence[str]) -> dict[str, list[float]]:
    counts = ("iteration", "episodes")
    return {
        **{name: [int(row[name]) for row in rows] for name in counts},
        **{name: [_rounded(row[name]) for row in rows] for name in names},
    }


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
