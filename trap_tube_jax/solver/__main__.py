"""The solver's command line: `python -m trap_tube_jax.solver --help`."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from trap_tube_jax.checks import check_seed
from trap_tube_jax.command_line import add_import_option, plain_errors
from trap_tube_jax.imports import import_modules
from trap_tube_jax.objects import DIRECTION_NAMES
from trap_tube_jax.observation import render_ascii
from trap_tube_jax.registry import make, task_set
from trap_tube_jax.rendering import episode_frames, save_gif
from trap_tube_jax.solver.distance import distances
from trap_tube_jax.solver.search import Plan, replay, solve
from trap_tube_jax.solver.survey import QUANTILES, Survey, survey
from trap_tube_jax.state import State
from trap_tube_jax.tables import markdown_table

DESCRIPTION = """Find exact shortest plans of the trap-tube tasks. Without --show and --distances,
print statistics of whole task sets and draw a histogram. Sets that differ in colours alone have
the same statistics."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    options = _parser().parse_args(arguments)
    with plain_errors():
        import_modules(options.imports)
        if options.show is not None:
            _show(options)
        elif options.distances is not None:
            _distances(options)
        else:
            _survey(options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m trap_tube_jax.solver",
        description=DESCRIPTION,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--sets", nargs="+", default=["base", "sy", "p", "psy"], metavar="SET", help="task sets")
    add("--tasks", type=int, default=1000, help="tasks to solve per set")
    add("--seed", type=int, default=0, help="seed of the tasks, 0 to 2**32 - 1")
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--show", metavar="SET", help="plan one task, as text and GIF")
    modes.add_argument("--distances", metavar="SET", help="draw distances to the goal in one task")
    add("--output", type=Path, help="file to write, shortest_plans.png, plan.gif or distances.png")
    add("--format", choices=("text", "json"), default="text", help="format of what is printed")
    add_import_option(parser)
    return parser


def _survey(options: argparse.Namespace) -> None:
    from trap_tube_jax.solver.pictures import save_histogram  # noqa: PLC0415  matplotlib is slow

    sets = [task_set(name) for name in options.sets]
    surveys = []
    for entry in sets:
        print(f"solving {options.tasks:,} tasks of {entry.label}", file=sys.stderr)
        surveys.append(survey(entry, tasks=options.tasks, seed=options.seed))
    path = options.output or Path("shortest_plans.png")
    save_histogram(surveys, path)
    summaries = [entry.summary() for entry in surveys]
    _print(options, summaries, _table(surveys))
    print(f"histogram: {path}", file=sys.stderr)


def _show(options: argparse.Namespace) -> None:
    state = _task(options.show, options.seed)
    plan = solve(state)
    path = options.output or Path("plan.gif")
    save_gif(episode_frames(state, plan.actions, cell_size=32), path, fps=4)
    report = {
        "id": task_set(options.show).id,
        "seed": options.seed,
        "solvable": bool(plan.solvable),
        "length": int(plan.length),
        "actions": plan.actions.tolist(),
    }
    boards = (
        f"{_caption(plan, time)}\n{render_ascii(at)}\n"
        for time, at in enumerate(replay(state, plan))
    )
    _print(options, report, "\n".join(boards))
    print(f"animation: {path}", file=sys.stderr)


def _distances(options: argparse.Namespace) -> None:
    from trap_tube_jax.solver.pictures import save_distances  # noqa: PLC0415  matplotlib is slow

    state = _task(options.distances, options.seed)
    plan, found = solve(state), distances(state)
    path = options.output or Path("distances.png")
    save_distances(state, plan, found, path)
    report = {
        "id": task_set(options.distances).id,
        "seed": options.seed,
        "length": int(plan.length),
        "reachable": found.num_reachable,
        "solvable": int(np.count_nonzero(found.to_goal >= 0)),
        "farthest": int(found.to_goal.max()),
    }
    _print(options, report, "\n".join(f"{name}: {value}" for name, value in report.items()))
    print(f"picture: {path}", file=sys.stderr)


def _print(options: argparse.Namespace, report: Any, text: str) -> None:
    print(json.dumps(report, indent=2) if options.format == "json" else text)


def _table(surveys: Sequence[Survey]) -> str:
    quantiles = (f"{quantile} %" for quantile in QUANTILES)
    rows = [["set", "tasks", "solvable", "mean", *quantiles, "longest"]]
    for entry in surveys:
        summary = entry.summary()
        rows.append(
            [
                entry.task_set.label,
                str(summary["tasks"]),
                f"{100 * summary['solvable']:.2f} %",
                _number(summary["mean"], 1),
                *(_number(value, 0) for value in summary["quantiles"].values()),
                _number(summary["longest"], 0),
            ]
        )
    return f"Steps of the shortest plans\n\n{markdown_table(rows)}"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _task(name: str, seed: int) -> State:
    return make(name).reset(jax.random.key(check_seed(seed)))[0]


def _caption(plan: Plan, time: int) -> str:
    if time:
        grasp, move = (DIRECTION_NAMES[direction] for direction in plan.actions[time - 1])
        return f"step {time}: grasp {grasp}, move {move}"
    return f"start ({f'{plan.length} steps' if plan.solvable else 'unsolvable'})"


if __name__ == "__main__":
    main()
