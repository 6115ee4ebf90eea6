"""Reads logged metrics with the readers of TensorBoard and Weights & Biases."""

import contextlib
import sys
from types import SimpleNamespace

import pytest

from agents.runs.folder import RunFolder
from agents.runs.loggers import check_loggers, open_loggers
from agents.runs.metrics import append_rows, read_rows, rewind_rows
from agents.runs.run import Run, RunOptions
from agents.runs.session import train_run
from helpers.small_runs import small_config


def row(iteration, loss=0.5):
    counts = {"episodes": 8 * iteration, "transitions": 48 * iteration, "seconds": 0.5}
    return {"iteration": iteration, "validation_success": 0.5, **counts, "loss": loss}


def log(folder, iterations, loss, **chosen):
    """Trains as a process does that is killed: it closes nothing."""
    chosen = {"tensorboard": False, "wandb": False, **chosen}
    with open_loggers(folder.path, Run(small_config()), **chosen) as log_row:
        for iteration in iterations:
            append_rows(folder.metrics, [row(iteration, loss)])
            log_row(row(iteration, loss))


@pytest.mark.parametrize("options", [RunOptions(tensorboard=True), RunOptions(wandb=True)])
def test_a_missing_library_is_named_before_anything_is_written(options, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ImportError, match="logging"):
        train_run(tmp_path / "run", Run(small_config()), options)
    assert not (tmp_path / "run").exists()


def test_a_missing_key_is_named(monkeypatch):
    class Error(Exception):
        pass

    def login():
        raise Error("No API key configured.\nUse `wandb login`.")

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(login=login, Error=Error))
    with pytest.raises(ValueError, match=r"--wandb cannot log: No API key.*WANDB_MODE=offline"):
        check_loggers(RunOptions(wandb=True))
    check_loggers(RunOptions())


def test_a_run_that_wandb_cannot_begin_is_an_error_of_one_line(monkeypatch, tmp_path):
    class Error(Exception):
        pass

    def init(**_):
        raise Error("Network\nunreachable.")

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init, Error=Error))
    with pytest.raises(ValueError, match=r"--wandb cannot log: Network unreachable\. WANDB_MODE"):
        log(RunFolder(tmp_path), [1], loss=0.25, wandb=True)


@pytest.mark.interop
def test_tensorboard_shows_metrics_of_a_killed_and_resumed_run_once(tmp_path):
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    folder = RunFolder(tmp_path)
    log(folder, [1, 2, 3, 4], loss=0.25, tensorboard=True)
    rewind_rows(folder.metrics, 2)
    log(folder, [3, 4, 5], loss=0.75, tensorboard=True)
    events = reader.EventAccumulator(str(folder.tensorboard)).Reload()
    logged = [(e.step, e.tensor_proto.float_val[0]) for e in events.Tensors("loss")]
    rows = read_rows(folder.metrics)
    assert logged == list(zip(rows["iteration"], rows["loss"], strict=True))


@pytest.fixture
def offline(monkeypatch):
    """Weights & Biases without a network."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    return pytest.importorskip("wandb")


@pytest.mark.interop
def test_seeds_of_one_program_are_runs_of_wandb_beside_the_callers(tmp_path, offline):
    """A row belongs to the run that logs it."""
    seeds = ("0", "1")
    with offline.init(dir=tmp_path) as callers, contextlib.ExitStack() as stack:
        for name in seeds:
            path = RunFolder(tmp_path / name).path
            path.mkdir()
            chosen = {"tensorboard": False, "wandb": True}
            log_row = stack.enter_context(open_loggers(path, Run(small_config()), **chosen))
            log_row({**row(1), f"seed_{name}": 0.25})
        assert offline.run is callers
    for name in seeds:
        (log,) = (tmp_path / name / "wandb").glob("offline-run-*/*.wandb")
        found = [seed for seed in seeds if f"seed_{seed}".encode() in log.read_bytes()]
        assert found == [name]


@pytest.mark.interop
@pytest.mark.usefixtures("offline")
def test_a_resumed_run_is_the_same_run_of_wandb(tmp_path):
    folder = RunFolder(tmp_path)
    check_loggers(RunOptions(wandb=True))
    log(folder, [1, 2], loss=0.25, wandb=True)
    log(folder, [3], loss=0.25, wandb=True)
    logs = list((tmp_path / "wandb").glob("offline-run-*/*.wandb"))
    assert len(logs) == 2
    assert len({path.name for path in logs}) == 1  # named after the run
    assert any(b"validation_success" in path.read_bytes() for path in logs)
