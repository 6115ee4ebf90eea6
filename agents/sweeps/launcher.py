"""Trains the runs of a grid, several at a time, by any executor."""

import multiprocessing
from collections.abc import Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path
from typing import Any

from rich.console import Console

from agents.ppo import machine
from agents.runs.folder import RunFolder
from agents.runs.history import has_ended
from agents.runs.run import Run, RunOptions
from agents.sweeps.overview import Overview
from agents.sweeps.workers import Launch, ProcessPerCall, backend_of, log_of, train_logged
from trap_tube_jax.interruptions import Stopped, deferring

Group = Mapping[Path, Run]
DONE = "done"
STOPPED = "stopped"
LOST = "its worker, or the scheduler of the cluster, was lost"


def group_runs(
    runs: Group, options: RunOptions, executor: Executor, size: int | None = None
) -> list[dict[Path, Run]]:
    """Groups runs that one program trains: seeds of the same settings.

    `size` is the largest number of seeds in a program, by default as many as pay on the devices of
    the executor's workers.
    """
    several = len({run.seed for run in runs.values()}) > 1 and (options.devices or 1) == 1
    backend = backend_of(executor) if several and size is None else ""
    points: dict[Any, list[Path]] = {}
    for path, run in runs.items():
        pays = several and (size or machine.seeds_share_programs(run.config, backend))
        points.setdefault((run.config, run.algorithm) if pays else path, []).append(path)
    size = size or len(runs)
    parts = [x[i : i + size] for x in points.values() for i in range(0, len(x), size)]
    return [{path: runs[path] for path in part} for part in parts]


def launch(
    runs: Group,
    options: RunOptions,
    executor: Executor,
    console: Console,
    size: int | None = None,
) -> list[Path]:
    """Trains all runs, whose folders share a parent, and returns the folders of those that failed.

    The executor's workers share this file system. The console shows outcomes and progress. `size`
    is the largest number of seeds in a program; see `group_runs`.

    Raises:
      Stopped: on a signal, after all runs have saved their current iteration.
      KeyboardInterrupt: on a second signal; processes of this machine are killed.
    """
    # First, because the workers of a lost launcher are busy until they learn of this one.
    current = Launch.begin(next(iter(runs)).parent)
    failed: list[Path] = []
    count = 0
    try:
        groups = group_runs(runs, options, executor, size)
        with deferring(current.end) as request, Overview(console, runs) as overview:
            calls = {executor.submit(*_call(group, options, current)): group for group in groups}
            pending = set(calls)
            while pending:
                overview.show()
                # A wait without a timeout would miss a signal that arrives just before it.
                ended, pending = wait(pending, timeout=1, return_when=FIRST_COMPLETED)
                if request() and isinstance(executor, ProcessPerCall):
                    for call in pending:
                        call.cancel()  # unless it has begun; Dask would also drop those that have
                for call in (call for call in calls if call in ended):
                    for path, run in calls[call].items():
                        count += 1
                        outcome = _outcome(call, path, run, bool(request()))
                        console.out(f"[{count}/{len(runs)}] {path.name}: {outcome}")
                        failed += [] if outcome in (DONE, STOPPED) else [path]
            if number := request():
                raise Stopped(number)
    except KeyboardInterrupt:  # do not even wait for the current iteration
        for process in multiprocessing.active_children():
            process.kill()
        raise
    finally:
        current.end()
    return failed


def _call(group: Group, options: RunOptions, current: Launch) -> tuple:
    absolute = {path.absolute(): run for path, run in group.items()}  # a worker may run elsewhere
    return train_logged, absolute, options, current


def _outcome(call: Future, path: Path, run: Run, stopped: bool) -> str:
    """Returns `done`, `stopped` or an error; the run's files tell whether it is done."""
    crash = LOST if call.cancelled() else call.exception()  # its process was killed, for example
    error = None if crash else call.result().get(path.absolute())
    if not error and has_ended(RunFolder(path), run):
        return DONE
    if not error and stopped:
        return STOPPED
    log = log_of(path)
    return f"failed: {error or crash or LOST}{f'; see {log}' if log.exists() else ''}"
