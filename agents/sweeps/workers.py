"""Executors for a grid's runs, and the function that trains one run in a worker process."""

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from agents.parallel.devices import split_cpu
from agents.runs.compilation import enable_cache
from agents.runs.provenance import cores
from agents.runs.run import Run, RunOptions
from agents.runs.session import train_run
from agents.runs.stopping import Stopped
from trap_tube_jax.imports import import_modules, needs_extra

SPAWN = multiprocessing.get_context("spawn")


class ProcessPerCall(ThreadPoolExecutor):
    """Makes each call in a fresh process, so that a crash costs one call; threads only wait."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Schedules a call; function, arguments and result are pickled."""
        return super().submit(self._call, function, *args, **kwargs)

    def _call(self, *call: Any, **kwargs: Any) -> Any:
        threads = max(1, cores() // self._max_workers)
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
        with Client(cluster) as client:
            yield client.get_executor(pure=False)
        return
    if processes is None:
        with ProcessPoolExecutor(1, SPAWN) as pool:  # this process leaves GPUs to the runs
            processes = cores() if pool.submit(jax.default_backend).result() == "cpu" else 1
    with ProcessPerCall(processes) as executor:
        yield executor


def train_logged(path: Path, run: Run, options: RunOptions, stop_file: Path) -> str:
    """Trains a run, logs it next to its folder, and returns `done`, `stopped` or an error."""
    if stop_file.exists():
        return "stopped"
    with log_of(path).open("a", buffering=1, encoding="utf-8") as log:
        try:
            split_cpu(options.devices)  # first, because a module may start JAX
            import_modules(run.imports)
            enable_cache()
            train_run(path, run, options, console=Console(file=log), stop_file=stop_file)
        except Stopped:
            return "stopped"
        except Exception as error:
            traceback.print_exc(file=log)
            return f"failed: {error}"
    return "done"


def log_of(path: Path) -> Path:
    """Returns the log of the run in a folder."""
    return path.with_name(f"{path.name}.log")


def _begin(threads: int) -> None:
    os.environ.setdefault("NPROC", str(threads))  # for XLA, which starts one per core
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C arrives through the stop file
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
