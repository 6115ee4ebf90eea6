"""A grid of settings, every point with several seeds: python -m agents.sweep --help."""

import shlex
import sys
from collections.abc import Sequence

import jax

from agents.command_line import parse_all
from agents.files import lock_folder
from agents.runs.console import CommandConsole
from agents.runs.folder import RunFolder
from agents.runs.metrics import read_rows
from agents.sweeps import records
from agents.sweeps.grids import Grid
from agents.sweeps.launcher import launch
from agents.sweeps.workers import capacity, make_executor
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.interruptions import exit_when_stopped, run_command


def main(
    arguments: Sequence[str] | None = None,
    program: str = "python -m agents.sweep",
    name: str = "sweep",
    grid: Grid | None = None,
) -> None:
    """Runs a command line that trains a grid, by default a single point.

    Exits with 1 if a run failed, 2 if an option is not allowed, 128 + the signal's number if
    stopped.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    grid = grid or Grid()
    console = CommandConsole(highlight=False)
    jax.config.update("jax_platforms", "cpu")  # leaves other devices to the runs
    with plain_errors():
        options, run_options = parse_all([grid.options, grid.run_options], arguments, program)
        runs = grid.make_runs(name, options, run_options)
        root = next(iter(runs)).parent
        with exit_when_stopped(lambda: "The same command continues."), lock_folder(root):
            records.check(root, runs, run_options)
            with make_executor(options.processes, options.cluster) as executor:
                console.out(f"{len(runs)} run(s), {capacity(executor)}; logs: {root}/*.log")
                failed = launch(runs, run_options, executor, console, options.seeds_per_program)
                if any(len(read_rows(RunFolder(path).metrics)) for path in runs):
                    command = f"{program} {shlex.join(arguments)}".strip()
                    records.collect(root, command, runs, list(grid.configs(options)))
                    console.out(records.write_tables(root))
                    files = [root / "results.csv", root / "table.md", *records.draw(root)]
                    console.out("", *files, sep="\n")
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    run_command(main)
