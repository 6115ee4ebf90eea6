"""Runs trained side by side, each by a process of its own on cores of its own."""

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed

from agents import train
from agents.parallel.cores import available_cores
from agents.runs.folder import EXTENDABLE, Run, RunFolder
from agents.runs.stopping import Stopped, StopSignals

POLL_SECONDS = 0.5


class Worker(NamedTuple):
    """A process that trains a run.

    Attributes:
      folder: the run's files.
      process: the process; it stops where its standard input ends.
      cores: those that it runs on.
    """

    folder: RunFolder
    process: subprocess.Popen
    cores: list[int]


def default_processes() -> int:
    """How many runs to train at a time: on a CPU as many as there are cores, else one.

    On a GPU, several processes would compete for its memory and slow each other down.
    """
    program = "import jax; print(jax.default_backend())"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return len(available_cores()) if done.stdout.strip() == "cpu" else 1


def train_runs(
    runs: Sequence[tuple[RunFolder, Run]],
    processes: int,
    console: Console,
    stop: StopSignals,
) -> list[RunFolder]:
    """Trains runs to their end as `python -m agents.train --resume` does, some at a time.

    Args:
      runs: folders that hold the runs, and how these are to end.
      processes: how many at a time; each gets its share of the cores.
      console: where to show progress. What a run itself shows goes to its `log.txt`.
      stop: tells when to stop early.

    Returns:
      The runs that failed.

    Raises:
      Stopped: on request; every run has saved.
      KeyboardInterrupt: on a second request; the current iterations are lost.
    """
    waiting, working, failed = list(runs), list[Worker](), list[RunFolder]()
    cores = available_cores()
    free = [cores[first::processes] or cores for first in range(processes)]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Elapsed())
    told = False
    with stop, Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        everything = bars.add_task("runs", total=len(runs))
        try:
            while working or (waiting and not stop.received):
                while free and waiting and not stop.received:
                    working.append(_start(*waiting.pop(0), free.pop()))
                if stop.received and not told:
                    told = True
                    for worker in working:
                        worker.process.send_signal(stop.received)
                for worker in [each for each in working if each.process.poll() is not None]:
                    worker.process.communicate()  # closes its input
                    working.remove(worker)
                    free.append(worker.cores)
                    bars.advance(everything)
                    if _has_failed(worker, console, stop):
                        failed.append(worker.folder)
                time.sleep(POLL_SECONDS)
        finally:
            for worker in working:
                worker.process.kill()
                worker.process.communicate()
    if stop.received:
        raise Stopped(stop.received)
    return failed


def _command(folder: RunFolder, run: Run) -> list[str]:
    path = folder.path
    limits = [(f"--{name.replace('_', '-')}", getattr(run.config, name)) for name in EXTENDABLE]
    parts = (
        *(sys.executable, "-m", __name__, "--resume", "--name", path.name, "--out", path.parent),
        *itertools.chain.from_iterable(limits),
    )
    return [str(part) for part in parts]


def _start(folder: RunFolder, run: Run, cores: list[int]) -> Worker:
    with folder.log.open("a") as log:
        process = subprocess.Popen(
            _command(folder, run),
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C comes to us alone, who pass it on
        )
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(process.pid, cores)  # before it starts threads, which inherit it
    return Worker(folder, process, cores)


def _has_failed(worker: Worker, console: Console, stop: StopSignals) -> bool:
    """Says how a run has ended; whether it failed."""
    status, log = worker.process.returncode, worker.folder.log
    failed = status != 0 and not stop.received
    words = f"failed; see {log}" if failed else "stopped" if status else "done"
    console.print(f"{worker.folder.path.name}: {words}", soft_wrap=True, highlight=False)
    return failed


def _stop_with_parent() -> None:
    """Asks this process to stop when the one that started it is gone."""
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    train.main()
