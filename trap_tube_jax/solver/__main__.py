"""The solver's command line: python -m trap_tube_jax.solver --help."""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress
from rich.table import Table

from trap_tube_jax.checks import check_seed
from trap_tube_jax.command_line import Flag, Imports, plain_errors
from trap_tube_jax.imports import import_modules
from trap_tube_jax.objects import DIRECTION_NAMES
from trap_tube_jax.observation import render_ascii
from trap_tube_jax.registry import make, task_set
from trap_tube_jax.rendering import episode_frames, save_gif
from trap_tube_jax.solver.distance import Distances, distances
from trap_tube_jax.solver.search import Plan, replay, solve
from trap_tube_jax.solver.survey import QUANTILES, Survey, survey
from trap_tube_jax.state import State


@dataclasses.dataclass(frozen=True)
class Options:
    """Exact shortest plans of the trap-tube tasks.

    Without --show and --distances: the figures of whole task sets, as a table and as a
    histogram. Sets that differ in colours only have the same figures.

    Attributes:
      sets: ids or short names of task sets.
      tasks: tasks to solve per set.
      graphs: of how many of them to count the distinct reachable states (a second each).
      seed: the seed of the tasks, 0 to 2**32 - 1.
      show: id of a set: the plan of its task with this seed, as text and GIF instead.
      distances: id of a set: the distances to the goal in its task with this seed, as
        PNG instead.
      output: the file to write; shortest_plans.png, plan.gif or distances.png if absent.
      json: whether to print JSON in place of a table or text.
      imports: modules of your own to import first, for the sets that they register.
    """

    sets: tuple[str, ...] = ("base", "sy", "p", "psy")
    tasks: int = 1000
    graphs: int = 5
    seed: int = 0
    show: str | None = None
    distances: str | None = None
    output: Path | None = None
    json: Flag = False
    imports: Imports = ()


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    options = tyro.cli(Options, args=arguments, prog="python -m trap_tube_jax.solver")
    with plain_errors():
        import_modules(options.imports)
        if options.show is not None and options.distances is not None:
            raise ValueError("--show and --distances exclude each other; allowed: one of them")
        if options.show is not None:
            _show(options, options.show)
        elif options.distances is not None:
            _distances(options, options.distances)
        else:
            _survey(options)


def _survey(options: Options) -> None:
    from trap_tube_jax.solver.pictures import save_histogram  # noqa: PLC0415  matplotlib is slow

    if not options.sets:
        raise ValueError("--sets must name at least one task set, such as base")
    sets = [task_set(name) for name in options.sets]
    graphs = min(options.graphs, options.tasks)
    messages = Console(stderr=True)
    columns = [*Progress.get_default_columns(), MofNCompleteColumn()]
    surveys = []
    with Progress(*columns, console=messages, transient=True) as progress:
        for entry in sets:
            bar = progress.add_task(entry.label, total=options.tasks + graphs)
            surveys.append(
                survey(
                    entry,
                    tasks=options.tasks,
                    graphs=graphs,
                    seed=options.seed,
                    advance=lambda count, bar=bar: progress.advance(bar, count),
                )
            )
    if options.json:
        print(json.dumps([entry.summary() for entry in surveys], indent=2))
    else:
        Console().print(_table(surveys))
    path = options.output or Path("shortest_plans.png")
    save_histogram(surveys, path)
    messages.print(f"histogram: {path}")


def _table(surveys: Sequence[Survey]) -> Table:
    table = Table(title="Shortest plans, in steps", box=SIMPLE_HEAD, padding=(0, 0, 0, 1))
    table.add_column("set")
    headers = ["tasks", "solvable", "mean", *(f"{q} %" for q in QUANTILES), "longest", "states"]
    for header in headers:
        table.add_column(header, justify="right")
    for entry in surveys:
        summary = entry.summary()
        table.add_row(
            entry.task_set.label,
            str(summary["tasks"]),
            f"{100 * summary['solvable']:.2f} %",
            _number(summary["mean"], 1),
            *(_number(value, 0) for value in summary["quantiles"].values()),
            _number(summary["longest"], 0),
            _number(summary["reachable"]["mean"], 0, unit=1000),
        )
    count = len(surveys[0].reachable)
    table.caption = f"states: thousand distinct reachable states, mean of the first {count} tasks"
    return table


def _number(value: float | None, digits: int, unit: int = 1) -> str:
    return "-" if value is None else f"{value / unit:,.{digits}f}"


def _show(options: Options, name: str) -> None:
    state = _task(name, options.seed)
    plan = solve(state)
    if options.json:
        print(_plan_json(options, name, plan))
    else:
        for time, at in enumerate(replay(state, plan)):
            print(f"{_caption(plan, time)}\n{render_ascii(at)}\n")
    path = options.output or Path("plan.gif")
    save_gif(episode_frames(state, plan.actions, cell_size=32), path, fps=4)
    print(f"animation: {path}", file=sys.stderr)


def _distances(options: Options, name: str) -> None:
    from trap_tube_jax.solver.pictures import save_distances  # noqa: PLC0415

    state = _task(name, options.seed)
    plan, found = solve(state), distances(state)
    report = {
        "id": task_set(name).id,
        "seed": options.seed,
        "length": int(plan.length),
        **_counts(found),
    }
    if options.json:
        print(json.dumps(report, indent=2))
    else:
        print(_distances_line(plan, found))
    path = options.output or Path("distances.png")
    save_distances(state, plan, found, path)
    print(f"picture: {path}", file=sys.stderr)


def _counts(found: Distances) -> dict[str, int]:
    """The states that can be reached, those with a way to the goal, and the longest way."""
    return {
        "reachable": found.num_reachable,
        "solvable": int(np.count_nonzero(found.to_goal >= 0)),
        "farthest": int(found.to_goal.max()),
    }


def _distances_line(plan: Plan, found: Distances) -> str:
    reachable, solvable, farthest = _counts(found).values()
    way = "none of them with a way to the goal"
    if solvable:
        way = f"{solvable:,} of them with a way to the goal, at most {farthest} steps"
    return f"{reachable:,} reachable states, {way}; {_outcome(plan)} from the start"


def _task(name: str, seed: int) -> State:
    return make(name).reset(jax.random.key(check_seed(seed)))[0]


def _caption(plan: Plan, time: int) -> str:
    if time == 0:
        return f"start ({_outcome(plan)})"
    grasp, move = (DIRECTION_NAMES[direction] for direction in plan.actions[time - 1])
    return f"step {time}: grasp {grasp}, move {move}"


def _outcome(plan: Plan) -> str:
    return f"{plan.length} steps" if plan.solvable else "unsolvable"


def _plan_json(options: Options, name: str, plan: Plan) -> str:
    report = {
        "id": task_set(name).id,
        "seed": options.seed,
        "solvable": bool(plan.solvable),
        "length": int(plan.length),
        "actions": plan.actions.tolist(),
    }
    return json.dumps(report, indent=2)


if __name__ == "__main__":
    main()
