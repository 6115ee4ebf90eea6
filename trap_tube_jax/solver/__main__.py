"""The solver's command line: `python -m trap_tube_jax.solver --help`."""

import argparse
import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np

from trap_tube_jax.checks import MAX_TASKS, check_integer, check_seed
from trap_tube_jax.command_line import add_import_option, announce, path_argument, plain_errors
from trap_tube_jax.dynamics import replay
from trap_tube_jax.imports import import_modules
from trap_tube_jax.interruptions import run_command
from trap_tube_jax.objects import DIRECTION_NAMES
from trap_tube_jax.observation import render_ascii
from trap_tube_jax.registry import make, task_set
from trap_tube_jax.rendering import episode_frames, save_gif
from trap_tube_jax.solver.distance import distances
from trap_tube_jax.solver.search import Plan, solve, solve_batch
from trap_tube_jax.state import State, take
from trap_tube_jax.tables import markdown_table

DESCRIPTION = """Finds exact shortest plans of the trap-tube tasks. Without --show and --distances,
prints statistics of whole task sets and draws a histogram. Sets that differ only in colours have
the same statistics. Only the pictures need the extra [pictures]."""
SURVEYED = ("base", "sy", "p", "psy")
TASKS = 1000  # to survey per set
QUANTILES = (5, 25, 50, 75, 95)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    options = _parser().parse_args(arguments)
    with plain_errors():
        import_modules(options.imports)
        if options.output is not None:
            options.output.parent.mkdir(parents=True, exist_ok=True)
        if options.show is None and options.distances is None:
            _survey(options)
        elif options.sets is not None or options.tasks is not None:
            raise ValueError("--sets and --tasks are not allowed with --show and --distances")
        elif options.show is not None:
            _show(options)
        else:
            _distances(options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m trap_tube_jax.solver", description=DESCRIPTION)
    add = parser.add_argument
    add(
        "--sets",
        nargs="+",
        metavar="SET",
        help=f"task sets [{' '.join(SURVEYED)}]",
    )
    add("--tasks", type=int, help=f"tasks to solve per set [{TASKS}]")
    add("--seed", type=int, default=0, help="seed of the tasks, 0 to 2**32 - 1 [%(default)s]")
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--show", metavar="SET", help="plan one task, as text and GIF")
    modes.add_argument("--distances", metavar="SET", help="draw distances to the goal in one task")
    add(
        "--output",
        type=path_argument,
        help="file to write, by default shortest_plans.png, plan.gif or distances.png",
    )
    add_import_option(parser)
    return parser


def _survey(options: argparse.Namespace) -> None:
    tasks = TASKS if options.tasks is None else options.tasks
    check_integer("tasks", tasks, maximum=MAX_TASKS)
    keys = jax.random.split(jax.random.key(check_seed(options.seed)), tasks)
    lengths = {}
    for entry in dict.fromkeys(task_set(name) for name in options.sets or SURVEYED):
        announce(f"Solving {tasks:,} tasks of {entry.label}, up to a minute per 1,000 tasks")
        states, _ = jax.jit(jax.vmap(make(entry.id).reset))(keys)
        lengths[entry.label] = solve_batch(states).length
    quantiles = (f"{quantile} %" for quantile in QUANTILES)
    head = ["set", "tasks", "solvable", "mean", *quantiles, "longest"]
    rows = [row_of_lengths(label, length) for label, length in lengths.items()]
    print(f"Steps of the shortest plans\n\n{markdown_table([head, *rows])}")
    with _drawing(options, "shortest_plans.png") as path:
        from trap_tube_jax.solver.pictures import save_histogram  # noqa: PLC0415

        save_histogram(lengths, path)


def row_of_lengths(label: str, length: np.ndarray) -> list[str]:
    """Returns the cells of a set whose tasks' shortest plans have `length` i32[T], -1 for none."""
    solved = length[length >= 0]
    start = [label, str(len(length)), f"{100 * len(solved) / len(length):.2f} %"]
    if not len(solved):
        return start + ["-"] * (len(QUANTILES) + 2)
    quantiles = (f"{value:.0f}" for value in np.percentile(solved, QUANTILES))
    return [*start, f"{solved.mean():.1f}", *quantiles, str(solved.max())]


def _show(options: argparse.Namespace) -> None:
    state = _task(options.show, options.seed)
    plan = solve(state)
    states = replay(state, plan.actions)
    for time in range(len(states.time)):
        print(f"{_caption(plan, time)}\n{render_ascii(take(states, time))}\n")
    with _drawing(options, "plan.gif") as path:
        save_gif(episode_frames(state, plan.actions, cell_size=32), path, fps=4)


def _distances(options: argparse.Namespace) -> None:
    state = _task(options.distances, options.seed)
    plan = solve(state)
    announce("Exploring up to two million states, which takes seconds")
    found = distances(state)
    print(f"length of the plan: {plan.length if plan.solvable else 'unsolvable'}")
    print(f"states with a way to the goal: {np.count_nonzero(found >= 0)}")
    if plan.solvable:
        print(f"farthest from the goal: {found.max()}")
    with _drawing(options, "distances.png") as path:
        from trap_tube_jax.solver.pictures import save_distances  # noqa: PLC0415

        save_distances(state, plan, found, path)


@contextlib.contextmanager
def _drawing(options: argparse.Namespace, default: str) -> Iterator[Path]:
    """Yields the file to draw. A missing library is an error only if `--output` names the file."""
    path = options.output or Path(default)
    try:
        yield path
    except ImportError as error:
        if options.output is not None:
            raise
        print(f"no picture: {error}", file=sys.stderr)
    else:
        print(f"picture: {path}", file=sys.stderr)


def _task(name: str, seed: int) -> State:
    return make(name).reset(jax.random.key(check_seed(seed)))[0]


def _caption(plan: Plan, time: int) -> str:
    if time:
        grasp, move = (DIRECTION_NAMES[direction] for direction in plan.actions[time - 1])
        return f"step {time}: grasp {grasp}, move {move}"
    return f"start ({f'{plan.length} steps' if plan.solvable else 'unsolvable'})"


if __name__ == "__main__":
    run_command(main)
