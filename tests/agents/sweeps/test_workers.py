"""Processes of runs: one per call, failures alone, logs next to the folders."""

import os
import signal

import pytest

from agents.config import Config
from agents.runs.run import Run, RunOptions
from agents.runs.stopping import Stopped
from agents.sweeps import workers


def test_a_killed_process_costs_one_call():
    with workers.make_executor(1, None) as executor:
        killed = executor.submit(signal.raise_signal, signal.SIGKILL)
        other = executor.submit(os.getpid)
        assert "terminated abruptly" in str(killed.exception())
        assert other.result() != os.getpid()


@pytest.mark.parametrize(
    ("raises", "outcome", "logged"),
    [
        (None, "done", "training [b]x[/b]\n"),
        (Stopped(15), "stopped", "training [b]x[/b]\n"),
        (ValueError("no [red]luck"), "failed: no [red]luck", "ValueError: no [red]luck\n"),
    ],
)
def test_a_run_is_logged_next_to_its_folder(tmp_path, monkeypatch, raises, outcome, logged):
    def train_run(path, run, options, *, console, stop_file):
        console.print("training [b]x[/b]", markup=False)
        if raises:
            raise raises

    monkeypatch.setattr(workers, "train_run", train_run)
    stop_file = tmp_path / ".stop"
    arguments = (tmp_path / "a-seed0", Run(Config()), RunOptions(), stop_file)
    assert workers.train_logged(*arguments) == outcome
    assert (tmp_path / "a-seed0.log").read_text().endswith(logged)
    stop_file.touch()
    assert workers.train_logged(*arguments) == "stopped"


def test_devices_are_split_before_modules_are_imported(tmp_path, monkeypatch):
    order = []
    for name in ("split_cpu", "import_modules", "train_run"):
        monkeypatch.setattr(workers, name, lambda *_, name=name, **__: order.append(name))
    workers.train_logged(tmp_path / "a", Run(Config()), RunOptions(devices=2), tmp_path / ".stop")
    assert order == ["split_cpu", "import_modules", "train_run"]


def test_dask_is_an_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(ImportError, match=r"pip install 'trap-tube-jax\[cluster\]'"):
        workers.make_executor(None, "tcp://nowhere:1").__enter__()
