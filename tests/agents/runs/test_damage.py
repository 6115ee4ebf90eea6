"""Damaged files of a run or a grid: refused in one line with the path, and nothing is changed."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import safetensors.numpy

from agents.arrays import to_arrays
from agents.runs import checkpoint
from agents.runs.folder import STORED, RunFolder
from agents.runs.loading import load, save
from agents.runs.metrics import COLUMNS, read_rows, rewind_rows
from agents.runs.provenance import note_provenance
from agents.runs.results import metrics, results
from agents.runs.run import Run, RunOptions
from agents.sweeps import records
from helpers.small_runs import stored_run
from helpers.tiny_policy import CONFIG, random_params, random_policy


def without(row: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name != key}


CHECKPOINT = "checkpoints/4.safetensors"
RUN = {**Run(CONFIG).to_dict(), "options": {"sets": None}}
METRICS = {
    "iteration": 4, "episodes": 8, "transitions": 40, "seconds": 0.5,
    "validation_success": 0.5, "loss": 0.25,
}  # fmt: skip
EVALUATION = {
    "iteration": 4, "purpose": "test", "task_set": "p", "tasks": 2, "solved": 1,
    "layouts": "", "layouts_total": "", "length": 6.5,
}  # fmt: skip
CURVE = {"algorithm": "ppo", "seed": 0, **without(METRICS, "loss"), "success": 0.5}
RESULT = {"run": "a", "algorithm": "ppo", "seed": 0, **EVALUATION}
GRID = {
    "title": "x", "commands": ["x"], "train_set": "p", "threshold": 1.0,
    "settings": {}, "machines": [], "unfinished": [["ppo", 0]],
}  # fmt: skip
PARAMS = to_arrays(random_params())
ARRAYS = safetensors.numpy.save(PARAMS, {"json": json.dumps({"iteration": 4})})

# What reads a file of a run or a grid, by the file's name.
READERS: dict[str, list[Any]] = {
    "config.json": [RunFolder.read],
    "provenance.json": [lambda run: note_provenance(run.provenance, "cpu")],
    "metrics.csv": [
        lambda run: read_rows(run.metrics),
        lambda run: rewind_rows(run.metrics, 3),
        lambda run: metrics(run.path),
    ],
    "evaluations.csv": [
        lambda run: read_rows(run.evaluations),
        lambda run: rewind_rows(run.evaluations, 3),
        lambda run: results(run.path),
    ],
    CHECKPOINT: [
        lambda run: checkpoint.load(run.checkpoints),
        lambda run: load(run.path, iteration=4),
    ],
    "best.safetensors": [lambda run: load(run.path)],
    "curves.csv": [lambda run: records.read(run.path)],
    "results.csv": [lambda run: records.read(run.path)],
    "grid.json": [lambda run: records.read(run.path)],
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A folder with every file of a run and of a grid."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    folder = stored_run(path, Run(CONFIG), [METRICS], [EVALUATION], RunOptions(evaluate_every=2))
    note_provenance(folder.provenance, "cpu")
    checkpoint.save(folder.checkpoints, 4, {"params": random_params()}, METRICS)
    save(folder.best, random_policy().replace(iteration=4))
    (folder.path / "curves.csv").write_bytes(csv_file(CURVE))
    (folder.path / "results.csv").write_bytes(csv_file(RESULT))
    (folder.path / "grid.json").write_text(json.dumps(GRID))
    records.write_tables(folder.path)
    return folder.path


def json_file(values: Any) -> bytes:
    return json.dumps(values).encode()


def csv_file(row: dict[str, Any], **changes: Any) -> bytes:
    changed = {**row, **changes}
    return f"{','.join(changed)}\n{','.join(map(str, changed.values()))}\n".encode()


OTHER_ENCODING = b"\xff\xfe\n"
DAMAGES = {
    **{
        (name, kind): content
        for name in ("config.json", "provenance.json", "grid.json")
        for kind, content in {"empty": b"", "cut": b"{", "encoding": OTHER_ENCODING}.items()
    },
    **{("config.json", f"no {key}"): json_file(without(RUN, key)) for key in STORED},
    **{
        ("config.json", str(change)): json_file({**RUN, **change})
        for change in (
            {"config": []},
            {"config": {"hidden": {}}},
            {"config": {"hidden": "x"}},
            {"config": {"later": 1}},
            {"seed": "0"},
            {"later": 1},
            {"options": {"later": 1}},
            {"options": {"sets": ["q"]}},
            {"options": {"checkpoint_every": 0}},
        )
    },
    **{
        (name, kind): content
        for name, row in {
            "metrics.csv": METRICS,
            "evaluations.csv": EVALUATION,
            "curves.csv": CURVE,
            "results.csv": RESULT,
        }.items()
        for kind, content in {
            "text": csv_file(row, iteration="abc"),
            "encoding": csv_file(row) + OTHER_ENCODING,
            "long row": csv_file(row) + b"1" + b",1" * 20 + b"\n",
            "short row": csv_file(row) + b"1,2\n",
            "no column": csv_file(without(row, list(COLUMNS[name])[-1])),
        }.items()
    },
    (CHECKPOINT, "empty"): b"",
    (CHECKPOINT, "cut"): ARRAYS[:-9],
    (CHECKPOINT, "no metadata"): safetensors.numpy.save(PARAMS),
    ("best.safetensors", "cut"): ARRAYS[:-9],
}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("name", "kind"), DAMAGES, ids=ascii)
def test_damage_is_one_line_with_the_path(name, kind, whole, tmp_path):
    path = tmp_path / "run" / name
    shutil.copytree(whole, tmp_path / "run")
    path.write_bytes(DAMAGES[name, kind])
    before = contents(tmp_path)
    for read in READERS[name]:
        with pytest.raises(ValueError, match=name) as error:
            read(RunFolder(tmp_path / "run"))
        message = str(error.value)
        assert str(path) in message
        assert "\n" not in message
        assert len(message) < 2000
    assert contents(tmp_path) == before
