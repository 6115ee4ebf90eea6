"""The solver's command line: `python -m trap_tube_jax.solver --help`."""

import argparse
from collections.abc import Sequence

import jax
import numpy as np

from trap_tube_jax.checks import MAX_TASKS, check_integer, check_seed
from trap_tube_jax.command_line import add_import_option, announce, plain_errors
from trap_tube_jax.imports import import_modules
from trap_tube_jax.interruptions import run_command
from trap_tube_jax.registry import make, task_set
from trap_tube_jax.solver.search import solve_batch
from trap_tube_jax.tables import markdown_table

DESCRIPTION = """Finds exact shortest plans of the trap-tube tasks and prints statistics of
task sets. Sets that differ only in colours have the same statistics."""
SURVEYED = ("base", "sy", "p", "psy")
TASKS = 1000  # to survey per set
QUANTILES = (5, 25, 50, 75, 95)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    options = _parser().parse_args(arguments)
    with plain_errors():
        import_modules(options.imports)
        _survey(options)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m trap_tube_jax.solver", description=DESCRIPTION)
    add = parser.add_argument
    sets = f"task sets [{' '.join(SURVEYED)}]"
    add("--sets", nargs="+", metavar="SET", default=SURVEYED, help=sets)
    add("--tasks", type=int, default=TASKS, help="tasks to solve per set [%(default)s]")
    add("--seed", type=int, default=0, help="seed of the tasks, 0 to 2**32 - 1 [%(default)s]")
    add_import_option(parser)
    return parser


def _survey(options: argparse.Namespace) -> None:
    tasks = check_integer("tasks", options.tasks, maximum=MAX_TASKS)
    keys = jax.random.split(jax.random.key(check_seed(options.seed)), tasks)
    lengths = {}
    for entry in dict.fromkeys(task_set(name) for name in options.sets):
        announce(f"Solving {tasks:,} tasks of {entry.label}, up to a minute per 1,000 tasks")
        states, _ = jax.jit(jax.vmap(make(entry.id).reset))(keys)
        lengths[entry.label] = solve_batch(states).length
    quantiles = (f"{quantile} %" for quantile in QUANTILES)
    head = ["set", "tasks", "solvable", "mean", *quantiles, "longest"]
    rows = [row_of_lengths(label, length) for label, length in lengths.items()]
    print(f"Steps of the shortest plans\n\n{markdown_table([head, *rows])}")


def row_of_lengths(label: str, length: np.ndarray) -> list[str]:
    """Returns the cells of a set whose tasks' shortest plans have `length` i32[T], -1 for none."""
    solved = length[length >= 0]
    start = [label, str(len(length)), f"{100 * len(solved) / len(length):.2f} %"]
    if not len(solved):
        return start + ["-"] * (len(QUANTILES) + 2)
    quantiles = (f"{value:.0f}" for value in np.percentile(solved, QUANTILES))
    return [*start, f"{solved.mean():.1f}", *quantiles, str(solved.max())]


if __name__ == "__main__":
    run_command(main)
