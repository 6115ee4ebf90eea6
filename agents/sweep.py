"""A grid of settings, every point with several seeds: python -m agents.sweep --help."""

import shlex
import sys
from collections.abc import Sequence

import jax
from rich.console import Console

from agents.command_line import parse_all
from agents.runs.folder import RunFolder
from agents.runs.stopping import Stopped, exit_code
from agents.sweeps import records
from agents.sweeps.grids import Grid
from agents.sweeps.launcher import launch
from agents.sweeps.workers import make_executor
from trap_tube_jax.command_line import plain_errors


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
    arguments, grid = sys.argv[1:] if arguments is None else list(arguments), grid or Grid()
    console = Console(highlight=False)
    jax.config.update("jax_platforms", "cpu")  # leaves other devices to the runs
    with plain_errors():
        options, run_options = parse_all([grid.options, grid.run_options], arguments, program)
        runs = grid.make_runs(name, options)
        root = next(iter(runs)).parent
        try:
            with make_executor(options.processes, options.cluster) as pool, RunFolder(root).lock():
                failed = launch(runs, run_options, pool, console)
                if any(RunFolder(path).metrics.exists() for path in runs):
                    records.collect(root, f"{program} {shlex.join(arguments)}".strip())
                    console.out(records.write(root))
        except (Stopped, KeyboardInterrupt) as stopped:
            console.out("Stopped. The same command continues.")
            raise SystemExit(exit_code(stopped)) from None
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
