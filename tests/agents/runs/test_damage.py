"""Damaged and hostile files of a run: refused in one line with the path, and nothing is changed."""

import json
import os
import resource
import shutil
import signal
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from agents.arrays import to_arrays
from agents.runs import checkpoint
from agents.runs.folder import RunFolder
from agents.runs.loading import load, save
from agents.runs.metrics import SCHEMAS, append_rows, read_rows, rewind_rows
from agents.runs.provenance import Machine, note_provenance
from agents.runs.results import metrics, results
from agents.runs.run import Run, RunOptions
from agents.sweeps import records
from helpers.tiny_policy import CONFIG, random_params, random_policy


def without(row: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name != key}


ROOM = 2**30  # bytes that reading may allocate, whatever a file says
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
OF_A_RUN = {"run": "a", "algorithm": "ppo", "seed": 0}
CURVE = {**without(OF_A_RUN, "run"), **without(METRICS, "loss"), "success": 0.5}
RESULT = {**OF_A_RUN, **EVALUATION}
GRID = {
    "title": "x", "commands": ["x"], "train_set": "p", "threshold": 1.0,
    "settings": {}, "machines": [], "unfinished": [["ppo", 0]],
}  # fmt: skip
ABOUT = {"config": CONFIG.to_dict(), "iteration": 4}
PARAMS = to_arrays(random_params())

GRID_READERS = [
    lambda run: records.read(run.path),
    lambda run: records.check(run.path, {}, RunOptions()),
]
# What reads a file of a run or a grid, by the file's name.
READERS: dict[str, list[Any]] = {
    "config.json": [RunFolder.read, RunFolder.devices, lambda run: results(run.path)],
    "provenance.json": [
        lambda run: results(run.path),
        lambda run: note_provenance(run.provenance, "cpu"),
    ],
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
    "curves.csv": GRID_READERS,
    "results.csv": GRID_READERS,
    "grid.json": GRID_READERS,
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A folder with every file of a run and of a grid."""
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "whole")
    folder.path.mkdir()
    folder.write_config(Run(CONFIG), RunOptions(evaluate_every=2))
    note_provenance(folder.provenance, "cpu")
    append_rows(folder.metrics, [METRICS])
    append_rows(folder.evaluations, [EVALUATION])
    checkpoint.save(folder.checkpoints, 4, {"params": random_params()}, METRICS)
    save(folder.best, random_policy().replace(iteration=4))
    (folder.path / "curves.csv").write_bytes(csv_file(CURVE))
    (folder.path / "results.csv").write_bytes(csv_file(RESULT))
    (folder.path / "grid.json").write_text(json.dumps(GRID))
    records.write_tables(folder.path)
    return folder.path


def arrays_file(about: Any = ABOUT, **arrays: Any) -> bytes:
    return safetensors.numpy.save({**PARAMS, **arrays}, {"json": json.dumps(about)})


def raw_file(header: Any, data: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def eights(name: str = "x", dtype: str = "F8_E4M3", **about: Any) -> bytes:
    array = {"dtype": dtype, "shape": [4], "data_offsets": [0, 4]}
    return raw_file({name: array, "__metadata__": {"json": json.dumps(about)}}, bytes(4))


def csv_file(row: dict[str, Any], **changes: Any) -> bytes:
    changed = {**row, **changes}
    return f"{','.join(changed)}\n{','.join(map(str, changed.values()))}\n".encode()


IRREGULAR = {
    "folder": Path.mkdir,
    "fifo": os.mkfifo,
    "dangling": lambda path: path.symlink_to("gone"),
    "loop": lambda path: path.symlink_to(path.name),
    "endless": lambda path: path.symlink_to("/dev/zero"),
}
NO_JSON = {
    "empty": b"",
    "open": b"{",
    "null": b"null",
    "number": b"3",
    "text": b'"x"',
    "other encoding": b"\xff\xfe{}",
    "deep": b"[" * 100_000,
    "long number": b"1" * 10_000,
    "nested": b"[[{}]]",
}
# Values that a key of config.json cannot have.
WRONG = {
    "config": [None, [], 3, {"hidden": {}}, {"hidden": [[1]]}, {"env_id": "=1+1"}, {"hidden": "x"}],
    "seed": [None, "0", 1.5, True, -1, 10**30],
    "algorithm": [None, 3, "", "=1+1", "<b>", "a|b", "\x1b[2J", "a\nb"],
    "imports": [None, "os", [1], {}, ["\x1b[2J"]],
    "options": [
        None, [], {"report": "no"}, {"more": 1}, {"devices": 100_000}, {"devices": "2"},
        {"sets": "base"}, {"sets": ["q"]}, {"checkpoint_every": 0}, {"test_tasks": 10**30},
    ],
}  # fmt: skip
WRONG_ROWS = [
    *({"iteration": value} for value in ("abc", "", "-1", "1.5", "1e3", "٣", 10**30)),
    {"": 1},
    {"more\x1b": "x"},
]
WRONG_METRICS = [{"seconds": "inf"}, {"loss": "high"}, {"validation_success": "1,2"}]
WRONG_EVALUATIONS = [
    {"solved": 99},
    {"tasks": 0},
    {"task_set": "=1+1"},
    {"purpose": "=1+1"},
    {"length": "x"},
]
WRONG_ALGORITHMS = [{"algorithm": name} for name in WRONG["algorithm"][2:7]]
# What follows a good row.
CSV = {
    "other encoding": b"\xff\n",
    "long row": b"1" + b",1" * 20 + b"\n",
    "short row": b"1,2\n",
    "open quote": b'1,"2\n',
    "nul": b"\0\0\0\n",
}
MACHINE = {**dict.fromkeys(Machine.__required_keys__, "x"), "cores": 1, "commit": None}
ARRAYS = {
    "empty": b"",
    "zeros": bytes(100),
    "long header": struct.pack("<Q", 2**62) + b"{}",
    "no metadata": safetensors.numpy.save(PARAMS),
    "float8": eights(**ABOUT),
    "bfloat16": eights(dtype="BF16", **ABOUT),
    "name": eights("\x1b[2J\nerror: forged", "U8", **ABOUT),
    "deep": raw_file({"__metadata__": {"json": "[" * 100_000}}),
}
BEST = {
    "no iteration": arrays_file({"config": CONFIG.to_dict()}),
    "no config": arrays_file({"iteration": 4}),
    "negative": arrays_file({**ABOUT, "iteration": -1}),
    "list": arrays_file([]),
    "nan": arrays_file(**{"heads/params/value/bias": np.full(1, np.nan, np.float32)}),
    "infinite": arrays_file(**{"heads/params/value/bias": np.full(1, np.inf, np.float32)}),
    "more arrays": arrays_file(more=np.zeros(2)),
    "other shape": arrays_file(**{"heads/params/value/bias": np.zeros((2, 2), np.float32)}),
    "other dtype": arrays_file(**{"heads/params/value/bias": np.zeros(1, np.int32)}),
    "large network": arrays_file({**ABOUT, "config": {**CONFIG.to_dict(), "hidden": 65_536}}),
    "setting": arrays_file({**ABOUT, "config": {"hidden": {"x": 1}}}),
    "later": arrays_file({**ABOUT, "config": {**CONFIG.to_dict(), "later": 1}}),
}
RECORDS = {
    "no iteration": {},
    "other iteration": {"iteration": 3},
    "iteration of text": {"iteration": "4"},
    "list": [],
    "nested": {"iteration": 4, "x": {}},
}


Damages = dict[
    tuple[str, str], Any
]  # contents, or functions that make a path bad, by file and kind


def json_damages() -> Damages:
    found: Damages = {}
    for name in ("config.json", "provenance.json", "grid.json"):
        found |= {(name, kind): content for kind, content in NO_JSON.items()}
    for key, values in WRONG.items():
        runs = {
            "missing": without(RUN, key),
            **{repr(value): {**RUN, key: value} for value in values},
        }
        for kind, run in runs.items():
            found["config.json", f"{key} {kind}"] = json.dumps(run).encode()
    for key in GRID:
        found["grid.json", f"no {key}"] = json.dumps(without(GRID, key)).encode()
    changes = {"key": {"x": 1}, "cores": {"cores": "1"}, "commit": {"commit": "=1+1"}}
    for kind, change in changes.items():
        found["provenance.json", kind] = json.dumps([{**MACHINE, **change}]).encode()
    found["provenance.json", "part"] = json.dumps([without(MACHINE, "jax")]).encode()
    return found


def csv_damages() -> Damages:
    found: Damages = {}
    for name, row, wrong in (
        ("metrics.csv", METRICS, WRONG_METRICS),
        ("evaluations.csv", EVALUATION, WRONG_EVALUATIONS),
        ("curves.csv", CURVE, WRONG_ALGORITHMS),
        ("results.csv", RESULT, [*WRONG_EVALUATIONS[:4], *WRONG_ALGORITHMS]),
    ):
        for change in WRONG_ROWS + wrong:
            found[name, str(change)] = csv_file(row, **change)
        for kind, content in CSV.items():
            found[name, kind] = csv_file(row) + content
        for key in SCHEMAS[name].columns:
            found[name, f"no {key}"] = csv_file(without(row, key))
        found[name, "other columns"] = b"x,y\n"
        found[name, "names twice"] = b"iteration,iteration\n1,1\n"
    return found


def array_damages() -> Damages:
    found: Damages = {}
    for name in (CHECKPOINT, "best.safetensors"):
        found |= {(name, kind): content for kind, content in ARRAYS.items()}
    found |= {("best.safetensors", kind): content for kind, content in BEST.items()}
    return found | {(CHECKPOINT, kind): arrays_file(record) for kind, record in RECORDS.items()}


DAMAGES = {
    **{(name, kind): make for name in READERS for kind, make in IRREGULAR.items()},
    **json_damages(),
    **csv_damages(),
    **array_damages(),
}


@pytest.fixture
def limits():
    """Turns a hang or an allocation beyond `ROOM` into an error."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, before[1]))
    signal.alarm(120)
    yield
    signal.alarm(0)
    resource.setrlimit(resource.RLIMIT_AS, before)


def contents(folder: Path) -> dict[str, Any]:
    return {
        str(path): path.read_bytes() if path.is_file() and not path.is_symlink() else "other"
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize(("name", "kind"), DAMAGES, ids=ascii)
def test_damage_is_one_line_with_the_path(name, kind, whole, tmp_path, limits):
    path = tmp_path / "run" / name
    damage = DAMAGES[name, kind]
    shutil.copytree(whole, tmp_path / "run")
    path.unlink()
    path.write_bytes(damage) if isinstance(damage, bytes) else damage(path)
    before = contents(tmp_path)
    refusals = []
    for read in READERS[name]:
        try:
            read(RunFolder(tmp_path / "run"))
        except ValueError as error:
            refusals.append(str(error))
    assert refusals
    for message in refusals:
        assert str(path) in message
        assert message.isprintable(), "one line, which no terminal takes for a command"
        assert len(message) < 2000
    assert contents(tmp_path) == before
