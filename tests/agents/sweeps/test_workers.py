"""Processes of runs: one per call, failures alone, logs next to the folders."""

import contextlib
import os
import signal
from multiprocessing import resource_tracker

import pytest
from rich.console import Console

from agents.config import Config
from agents.files import lock_folder
from agents.runs.run import Run, RunOptions
from agents.sweeps import workers
from trap_tube_jax.interruptions import Stopped


def test_a_killed_process_costs_one_call():
    with workers.make_executor(1, None) as executor:
        killed = executor.submit(signal.raise_signal, signal.SIGKILL)
        other = executor.submit(os.getpid)
        assert "terminated abruptly" in str(killed.exception())
        assert other.result() != os.getpid()


def test_signals_do_not_reach_the_processes():
    """Neither while they start: a terminal sends Ctrl-C to all."""
    resource_tracker._resource_tracker._stop()  # pyright: ignore  # as in a new process
    with workers.make_executor(1, None) as executor:
        executor.submit(signal.raise_signal, signal.SIGINT).result()
        executor.submit(signal.raise_signal, signal.SIGTERM).result()


@pytest.mark.parametrize(
    ("ends", "error", "logged"),
    [
        (None, None, "training [b]x[/b]\n"),
        (Stopped(15), None, "training [b]x[/b]\n"),
        (ValueError("no [red]luck"), "no [red]luck", "ValueError: no [red]luck\n"),
    ],
)
def test_runs_are_logged_next_to_their_folders(tmp_path, monkeypatch, ends, error, logged):
    def train_runs(runs, options, *, consoles, stop):
        for console in consoles.values():
            console.print("training [b]x[/b]", markup=False)
        return {path: ends if path.name == "a" else None for path in runs}

    monkeypatch.setattr(workers, "train_runs", train_runs)
    launch = workers.Launch.begin(tmp_path)
    runs = {tmp_path / name: Run(Config(), seed) for seed, name in enumerate("ab")}
    found = workers.train_logged(runs, RunOptions(), launch)
    assert found == ({} if error is None else {tmp_path / "a": error})
    assert (tmp_path / "a.log").read_text().endswith(logged)
    launch.end()
    assert workers.train_logged(runs, RunOptions(), launch) == {}


def test_a_program_that_cannot_be_made_fails_all_its_runs(tmp_path):
    runs = {tmp_path / name: Run(Config(), seed) for seed, name in enumerate("ab")}
    launch = workers.Launch.begin(tmp_path)
    found = workers.train_logged(runs, RunOptions(devices=2), launch)
    assert list(found) == list(runs)
    assert all(text.startswith("runs of one program must") for text in found.values())


def test_devices_are_split_before_modules_are_imported(tmp_path, monkeypatch):
    order = []
    for name in ("split_cpu", "import_modules", "train_runs"):
        monkeypatch.setattr(workers, name, lambda *_, name=name, **__: order.append(name))
    launch = workers.Launch.begin(tmp_path)
    with contextlib.suppress(TypeError):  # no outcomes
        workers.train_logged({tmp_path / "a": Run(Config())}, RunOptions(devices=2), launch)
    assert order == ["split_cpu", "import_modules", "train_runs"]


def test_a_worker_waits_for_another_writer_until_it_is_to_stop(tmp_path, monkeypatch):
    launch = workers.Launch.begin(tmp_path)
    console = Console(record=True)
    waited = []

    def sleep(seconds):
        waited.append(seconds)
        if len(waited) == 2:
            launch.end()

    monkeypatch.setattr(workers.time, "sleep", sleep)
    workers.wait_for_writer(tmp_path / "a", launch, console)
    assert not waited
    with lock_folder(tmp_path / "a"):
        workers.wait_for_writer(tmp_path / "a", launch, console)
    assert waited == [1, 1]
    assert console.export_text().count("Waiting") == 1


def test_dask_is_an_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(ImportError, match=r"pip install 'trap-tube-jax\[cluster\]'"):
        workers.make_executor(None, "tcp://nowhere:1").__enter__()
