"""Executors for a grid's runs, and the function that trains runs in a worker process."""

import contextlib
import dataclasses
import logging
import multiprocessing
import os
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Self
from uuid import uuid4

import jax
from rich.console import Console

from agents.files import lock_folder, write_bytes
from agents.parallel.devices import split_cpu
from agents.runs.compilation import enable_cache
from agents.runs.provenance import cores
from agents.runs.run import Run, RunOptions
from agents.runs.session import train_runs
from trap_tube_jax.command_line import one_line
from trap_tube_jax.imports import import_modules, needs_extra
from trap_tube_jax.interruptions import Stopped, block_signals

SPAWN = multiprocessing.get_context("spawn")
MAX_WAIT = 600  # seconds; the longest iterations, with their evaluation, take a few minutes


class ProcessPerCall(ThreadPoolExecutor):
    """Makes each call in a fresh process; threads only wait.

    A crash fails one call; in `ProcessPoolExecutor(max_tasks_per_child=1)` it would fail all of
    them. Signals do not reach the processes: `Launch` ends them.
    """

    def __init__(self, processes: int):
        resource_tracker.ensure_running()  # which unblocks signals in the thread that starts it
        super().__init__(processes, initializer=block_signals)
        self.processes = processes

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Schedules a call; function, arguments and result are pickled."""
        return super().submit(self._call, function, *args, **kwargs)

    def _call(self, *call: Any, **kwargs: Any) -> Any:
        threads = max(1, cores() // self.processes)
        with ProcessPoolExecutor(1, SPAWN, _begin, (threads,)) as pool:
            return pool.submit(*call, **kwargs).result()


@contextlib.contextmanager
def make_executor(processes: int | None, cluster: str | None) -> Iterator[Executor]:
    """Makes the executor of a grid's runs; the arguments are fields of `grids.Options`.

    Raises:
      ValueError: `processes` is below 1.
      ImportError: Dask is not installed.
      OSError: the scheduler does not answer.
    """
    if cluster is not None:
        with needs_extra("cluster"):
            from distributed import Client  # noqa: PLC0415  # pyright: ignore
        # Calls of a lost scheduler are reported as failures, without tracebacks.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        with Client(cluster) as client:
            yield client.get_executor(pure=False)
        return
    if processes is None:
        with ProcessPerCall(1) as executor:
            processes = cores() if backend_of(executor) == "cpu" else 1
    with ProcessPerCall(processes) as executor:
        yield executor


def capacity(executor: Executor) -> str:
    """Says how many calls an executor makes at a time."""
    if isinstance(executor, ProcessPerCall):
        return f"up to {executor.processes} at a time"
    return "as many at a time as the cluster has workers"


def backend_of(executor: Executor) -> str:
    """Asks a worker for its kind of device; the launcher leaves GPUs to the workers."""
    return executor.submit(jax.default_backend).result()


@dataclasses.dataclass(frozen=True)
class Launch:
    """A launch of a grid, which its workers obey wherever they run.

    Unlike a signal, a file reaches other hosts, and workers whose launcher has died.

    Attributes:
      file: holds the name of the grid's current launch; missing between two launches.
      name: this launch.
    """

    file: Path
    name: str

    @classmethod
    def begin(cls, root: Path) -> Self:
        """Begins a launch of the grid in a folder; workers of earlier ones stop."""
        launch = cls(root.absolute() / ".launch", uuid4().hex)
        write_bytes(launch.file, launch.name.encode())
        return launch

    def end(self) -> None:
        """Asks the workers to stop after their current iteration."""
        self.file.unlink(missing_ok=True)

    def has_ended(self) -> bool:
        """Returns whether the workers are to stop."""
        try:
            return self.file.read_text() != self.name
        except FileNotFoundError:
            return True


def train_logged(runs: Mapping[Path, Run], options: RunOptions, launch: Launch) -> dict[Path, str]:
    """Trains runs by one program, and logs them next to their folders.

    Returns the errors of the runs that failed, by folder.
    """
    if launch.has_ended():
        return {}
    with contextlib.ExitStack() as stack:
        consoles = {}
        for path in runs:
            log = log_of(path).open("a", buffering=1, encoding="utf-8")
            consoles[path] = Console(file=stack.enter_context(log))
        outcomes: Mapping[Path, Any]
        try:
            split_cpu(options.devices)  # first, because a module may start JAX
            for run in runs.values():
                import_modules(run.imports)
            enable_cache()
            for path, console in consoles.items():
                wait_for_writer(path, launch, console)
            if launch.has_ended():
                return {}
            outcomes = train_runs(runs, options, consoles=consoles, stop=launch.has_ended)
        except Exception as error:
            outcomes = dict.fromkeys(runs, error)
        errors = {}
        for path, console in consoles.items():
            if isinstance(error := outcomes[path], Exception) and not isinstance(error, Stopped):
                traceback.print_exception(error, file=console.file)
                errors[path] = one_line(error)
        return errors


def wait_for_writer(path: Path, launch: Launch, console: Console) -> None:
    """Waits until a worker whose launcher has died has saved a run, at most for `MAX_WAIT`."""
    for second in range(MAX_WAIT):
        if launch.has_ended():
            return
        try:
            with lock_folder(path):
                return
        except ValueError:
            if not second:
                console.out("Waiting for the process that writes to this run ...")
            time.sleep(1)


def log_of(path: Path) -> Path:
    """Returns the log of the run in a folder."""
    return path.with_name(f"{path.name}.log")


def _begin(threads: int) -> None:
    os.environ.setdefault("NPROC", str(threads))  # for XLA, which starts one per core
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
