"""Trains the runs of a grid, several at a time, by any executor."""

import multiprocessing
from collections.abc import Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path

from rich.console import Console

from agents.ppo import machine
from agents.runs.folder import RunFolder
from agents.runs.history import has_ended
from agents.runs.run import Run, RunOptions
from agents.sweeps.overview import Overview
from agents.sweeps.workers import (
    DONE,
    STOPPED,
    Launch,
    backend_of,
    is_being_written,
    log_of,
    train_logged,
)
from trap_tube_jax.interruptions import Stopped, deferring

Group = Mapping[Path, Run]
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
    groups: list[dict[Path, Run]] = []
    for path, run in runs.items():
        pays = several and (size or machine.seeds_share_programs(run.config, backend))
        limit = (size or len(runs)) if pays else 1
        for group in groups:
            first = next(iter(group.values()))
            same = (first.config, first.algorithm) == (run.config, run.algorithm)
            if same and len(group) < limit:
                group[path] = run
                break
        else:
            groups.append({path: run})
    return groups


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
                if request():
                    _cancel_waiting({call: calls[call] for call in pending})
                    ended |= {call for call in pending if call.cancelled()}  # Dask does not tell
                    pending -= ended
                for call in (call for call in calls if call in ended):
                    for path, outcome in _outcomes(call, calls[call], bool(request())).items():
                        count += 1
                        text = f"{path.name}: {outcome}{_log(outcome, path)}"
                        console.out(f"[{count}/{len(runs)}] {text}")
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


def _outcomes(call: Future, group: Group, stopped: bool) -> dict[Path, str]:
    """Returns the outcomes of the runs of a call: `done`, `stopped` or an error.

    If a call was lost or reports `done`, the runs' files decide the outcome.
    """
    error = None if call.cancelled() else call.exception()  # its process was killed, for example
    if call.cancelled() or error:
        found = dict.fromkeys(group, STOPPED if call.cancelled() and stopped else DONE)
    else:
        found = dict(zip(group, call.result().values(), strict=True))
    for path, outcome in found.items():
        has_to_go_on = outcome == STOPPED and not stopped
        if has_to_go_on or (outcome == DONE and not has_ended(RunFolder(path), group[path])):
            found[path] = f"failed: {error or LOST}"
    return found


def _cancel_waiting(pending: Mapping[Future, Group]) -> None:
    """Cancels the calls that train nothing yet. Dask would also drop those that do."""
    for call, group in pending.items():
        if not any(path.exists() and is_being_written(path) for path in group):
            call.cancel()


def _log(outcome: str, path: Path) -> str:
    log = log_of(path)
    return f"; see {log}" if outcome not in (DONE, STOPPED) and log.exists() else ""
