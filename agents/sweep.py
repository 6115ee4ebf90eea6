"""A grid of settings, every point with several seeds: python -m agents.sweep --help."""

import multiprocessing
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path

import jax
from rich.console import Console

from agents.command_line import parse_all
from agents.experiments import report
from agents.experiments.grids import Grid
from agents.experiments.workers import ProcessPerCall, log_of, make_executor, train_logged
from agents.runs.folder import Run, RunFolder, RunOptions
from agents.runs.stopping import Stopped, exit_code, stop_signals
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
        options, how = parse_all([grid.options, grid.run], arguments, program)
        runs = grid.runs(name, options)
        root = next(iter(runs)).parent
        try:
            with make_executor(options.processes, options.cluster) as pool, RunFolder(root).lock():
                failed = launch(runs, how, pool, console)
                if any(RunFolder(path).metrics.exists() for path in runs):
                    report.collect(root, f"{program} {shlex.join(arguments)}".strip())
                    console.out(report.write(root))
        except (Stopped, KeyboardInterrupt) as stopped:
            console.out("Stopped. The same command continues.")
            raise SystemExit(exit_code(stopped)) from None
    if failed:
        raise SystemExit(1)


def launch(
    runs: Mapping[Path, Run], options: RunOptions, executor: Executor, console: Console
) -> list[Path]:
    """Trains all runs, whose folders share a parent, and returns the folders of those that failed.

    The executor's workers share this file system. The console shows each outcome.

    Raises:
      Stopped: on SIGINT or SIGTERM, after all runs have saved their current iteration.
      KeyboardInterrupt: on a second signal; processes of this machine are killed.
    """
    stop_file = next(iter(runs)).parent.absolute() / ".stop"

    def ask(text: str) -> None:
        stop_file.touch()
        console.out(text)

    stop_file.unlink(missing_ok=True)
    calls: dict[Future, Path] = {}
    failed: list[Path] = []
    with stop_signals(ask) as request:
        try:
            for path, run in runs.items():
                where = path.absolute()  # workers of a cluster may run in another folder
                calls[executor.submit(train_logged, where, run, options, stop_file)] = path
            for count, call in enumerate(_ended(calls), 1):
                if request() and isinstance(executor, ProcessPerCall):
                    for each in calls:  # on Dask this would also drop running calls
                        each.cancel()
                if call.cancelled():
                    continue
                error = call.exception()  # its process was killed, or Dask gave up
                path, outcome = calls[call], f"failed: {error}" if error else call.result()
                log = f"; see {log_of(path)}" if outcome.startswith("failed") else ""
                console.out(f"[{count}/{len(runs)}] {path.name}: {outcome}{log}")
                failed += [] if outcome == "done" else [path]
        except BaseException:  # do not even wait for the current iteration
            stop_file.touch()
            for call in calls:
                call.cancel()
            for process in multiprocessing.active_children():
                process.kill()
            raise
    stop_file.unlink(missing_ok=True)
    if number := request():
        raise Stopped(number)
    return failed


def _ended(calls: Iterable[Future]) -> Iterator[Future]:
    """Yields calls as they end; calls that end together keep their order.

    A wait without a timeout, as in `as_completed`, would miss a signal that arrives just before it.
    """
    pending = set(calls)
    while pending:
        ended, pending = wait(pending, timeout=1, return_when=FIRST_COMPLETED)
        yield from (call for call in calls if call in ended)


if __name__ == "__main__":
    main()
