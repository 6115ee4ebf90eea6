"""Training from its start or newest checkpoint to its results, of one run or of several seeds.

One process does one thing at a time: an iteration, then saving, then evaluation. No thread runs JAX
in the background.
"""

import contextlib
import dataclasses
import functools
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import jax
from rich.console import Console

import trap_tube_jax as tt
from agents.files import lock_folder
from agents.parallel import processes
from agents.runs.folder import RunFolder
from agents.runs.loggers import check_loggers
from agents.runs.program import Cohort, Program
from agents.runs.progress import Progress
from agents.runs.run import Run, RunOptions
from trap_tube_jax.interruptions import Stopped, deferring

# Scores on test tasks, None if they were known before, or the reason why the run did not end.
Outcome = tt.Scores | None | Stopped | ValueError | OSError


def train_run(
    path: str | Path,
    run: Run,
    options: RunOptions | None = None,
    *,
    console: Console | None = None,
    stop: Callable[[], bool] | None = None,
) -> tt.Scores | None:
    """Trains a run to its end from its newest checkpoint, evaluates it and writes its files.

    A finished run is not trained again: its options become `options`, and missing scores and a
    missing report are added. Only one process at a time may call `train_run` for a folder.

    Args:
      path: the run's folder, made if missing; `~` is the home folder.
      run: what to train; of a stored run only `EXTENDABLE` settings may differ.
      options: options for carrying the run out; by default the stored ones, if any.
      console: where progress is shown; nowhere if None.
      stop: training stops as on SIGTERM once it returns True. Unlike a signal, it reaches threads
        and other hosts.

    Returns:
      The scores on test tasks; None if the policy to report was tested before.

    Raises:
      ValueError: the run cannot be trained or continued, or it diverged.
      OSError: a file cannot be read or written.
      Stopped: on a signal or `stop`, after the current iteration has been saved.

    Example:
      >>> config = agents.Config.preset("fast", iterations=1, episodes_per_iteration=32)
      >>> options = agents.RunOptions(sets=("base",), report=False)
      >>> scores = agents.train_run("runs/mine", agents.Run(config), options)
      >>> scores["base"].tasks
      1
    """
    path = Path(path)
    if options is None and RunFolder(path).config.is_file():
        options = RunFolder(path).read()[1]
    consoles = {} if console is None else {path: console}
    outcome = train_runs({path: run}, options, consoles=consoles, stop=stop)[path]
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def train_runs(
    runs: Mapping[Path, Run],
    options: RunOptions | None = None,
    *,
    consoles: Mapping[Path, Console] | None = None,
    stop: Callable[[], bool] | None = None,
) -> dict[Path, Outcome]:
    """Trains runs that differ only in their seed, by one program; see `train_run`.

    A run that reaches its end, or fails, ends alone. A single run equals one of several up to the
    rounding of float32.

    Args:
      runs: the runs by folder.
      options: of all runs; for several runs `devices` is one.
      consoles: where the progress of a run is shown, by its folder.
      stop: see `train_run`.

    Returns:
      The outcomes by folder.

    Raises:
      ValueError: the settings cannot be trained with, or differ between runs.
    """
    options = options or RunOptions()
    configs = {run.config for run in runs.values()}
    if len(configs) > 1 or (len(runs) > 1 and (options.devices or 1) > 1):
        raise ValueError("runs of one program must differ only in their seed and use one device")
    if jax.process_index() > 0:  # only the first process's files are kept
        options = dataclasses.replace(options, report=False, tensorboard=False, wandb=False)
    check_loggers(options)
    program = Program(configs.pop(), options)
    outcomes: dict[Path, Outcome] = {}
    opened: dict[Path, Progress] = {}
    with contextlib.ExitStack() as stack:
        for path, run in runs.items():
            console = (consoles or {}).get(path) or Console(quiet=True)
            with capturing_outcome(outcomes, path):
                stored = RunFolder(path)
                folder = stack.enter_context(output_folder(stored))
                opened[path] = Progress(run, program, stored, folder, console)
                opened[path].begin()
        training = {
            path: progress
            for path, progress in opened.items()
            if path not in outcomes and not progress.is_trained
        }
        if training:
            train(program, training, outcomes, stop)
        for path, progress in opened.items():
            if path not in outcomes:
                with capturing_outcome(outcomes, path):
                    outcomes[path] = progress.finish()
    return {path: outcomes[path] for path in runs}


def train(
    program: Program,
    training: Mapping[Path, Progress],
    outcomes: dict[Path, Outcome],
    stop: Callable[[], bool] | None,
) -> None:
    """Trains runs together until their limits; adds the outcomes of those that fail or stop."""
    with contextlib.ExitStack() as stack:
        for path, progress in training.items():
            with capturing_outcome(outcomes, path):
                progress.begin_training(stack, len(training))
        training = {path: x for path, x in training.items() if path not in outcomes}
        if not training:
            return
        cohort = Cohort(program, [progress.state() for progress in training.values()])
        for index, progress in enumerate(training.values()):
            progress.state = functools.partial(cohort.state, index)
        request = stack.enter_context(deferring())
        while any(not p.is_trained for path, p in training.items() if path not in outcomes):
            started = time.perf_counter()
            metrics = cohort.advance()
            seconds = time.perf_counter() - started
            asked = signal.SIGTERM if stop is not None and stop() else request()
            # A signal may reach any process: all have to agree on it.
            number = processes.max_over_processes(asked)
            count = sum(not p.is_trained for path, p in training.items() if path not in outcomes)
            for index, (path, progress) in enumerate(training.items()):
                if path in outcomes:
                    continue
                with capturing_outcome(outcomes, path):
                    if not progress.is_trained:
                        progress.record(cohort.member(metrics, index), seconds / count)
                    if number:
                        progress.save()
                        raise Stopped(number)


@contextlib.contextmanager
def output_folder(stored: RunFolder) -> Iterator[RunFolder]:
    """Makes this process the writer of a run.

    Yields the run's folder; processes other than the first get a temporary folder.

    Raises ValueError if another process writes to the folder, OSError if it cannot be created.
    """
    if jax.process_index() == 0:
        with lock_folder(stored.path):
            yield stored
    else:
        with tempfile.TemporaryDirectory() as copy:
            yield RunFolder(Path(copy))


@contextlib.contextmanager
def capturing_outcome(outcomes: dict[Path, Outcome], path: Path) -> Iterator[None]:
    """Records a failure or stop as the outcome of one run, so that the others go on."""
    try:
        yield
    except (Stopped, ValueError, OSError) as error:
        outcomes[path] = error
