"""Trains the runs of a grid, several at a time, by any executor."""

import multiprocessing
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path

from rich.console import Console

from agents.runs.run import Run, RunOptions
from agents.runs.stopping import Stopped, stop_signals
from agents.sweeps.workers import ProcessPerCall, log_of, train_logged


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
