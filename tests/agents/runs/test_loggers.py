"""Metrics in TensorBoard and Weights & Biases, by their own readers."""

import sys

import pytest

from agents.runs.run import Run, RunOptions
from agents.runs.session import train_run
from small_runs import small_config


@pytest.mark.parametrize("options", [RunOptions(tensorboard=True), RunOptions(wandb=True)])
def test_a_missing_library_is_named_before_anything_is_written(options, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ImportError, match="logging"):
        train_run(tmp_path / "run", Run(small_config()), options)
    assert not (tmp_path / "run").exists()


@pytest.mark.interop
def test_tensorboard_gets_the_metrics(tmp_path):
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    options = RunOptions(tensorboard=True, report=False)
    train_run(tmp_path / "run", Run(small_config(iterations=2)), options)
    events = reader.EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()
    lines = (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    rows = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
    for row in rows:
        (event,) = [e for e in events.Tensors("loss") if e.step == int(row["iteration"])]
        assert event.tensor_proto.float_val[0] == pytest.approx(float(row["loss"]))


@pytest.mark.interop
def test_wandb_logs_offline(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    options = RunOptions(wandb=True, report=False)
    train_run(tmp_path / "run", Run(small_config(iterations=2)), options)
    (log,) = (tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb")
    assert b"intrinsic_reward" in log.read_bytes()
