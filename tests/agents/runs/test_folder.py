"""The folder of a run: its settings, what may change in them, and its one writer."""

import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.config import Config
from agents.files import lock_folder, read_json, write_json
from agents.runs.folder import RunFolder, check_name
from agents.runs.run import Run, RunOptions, check_continues
from helpers.refusal import assert_refused


def test_a_run_is_the_same_after_json():
    run = Run(Config.preset("best"), 5, "mine", ("my_module",), Path("runs/old"))
    assert Run.from_dict(json.loads(json.dumps(run.to_dict()))) == run
    assert Run(Config(curiosity="none")).algorithm == "ppo"
    assert Run(Config(curiosity="icm")).algorithm == "ppo+icm"
    assert Run(Config(), finetune="x").algorithm == "ppo+icm, fine-tuned"


def test_numbers_of_numpy_and_lists_are_stored_as_those_of_python(tmp_path):
    given: Any = {"checkpoint_every": np.int64(2), "test_tasks": np.uint16(4), "sets": ["p"]}
    imports: Any = ["my_module"]
    run = Run(Config(), np.arange(9)[3], imports=imports)
    options = RunOptions(**given)
    RunFolder(tmp_path).write_config(run, options)
    found = RunFolder(tmp_path).stored()
    assert (found["seed"], found["imports"]) == (3, ["my_module"])
    assert found["options"] == {**dataclasses.asdict(RunOptions()), **given}


@pytest.mark.parametrize(
    ("make", "values", "words"),
    [
        (partial(Run, Config()), {"seed": -1}, ["seed must be an integer >= 0 and <= 4294967295"]),
        (partial(Run, Config()), {"seed": 1.0}, ["seed must be an integer", "1.0"]),
        (RunOptions, {"checkpoint_every": 0}, ["checkpoint_every must be an integer >= 1, got 0"]),
        (RunOptions, {"evaluate_every": -1}, ["evaluate_every must be an integer >= 0, got -1"]),
        (RunOptions, {"test_tasks": 10**9}, ["test_tasks must be", "<= 1000000, got 1000000000"]),
        (RunOptions, {"sets": ("q",)}, ["unknown task set 'q'"]),
        (RunOptions, {"sets": "pst"}, ["sets must be a tuple of names, got 'pst'"]),
        (partial(Run, Config()), {"imports": "json"}, ["imports must be a tuple of names"]),
        (RunOptions, {"sets": ()}, ["sets must name one or more task sets"]),
        (RunOptions, {"devices": 0}, ["devices must be an integer >= 1"]),
        *(
            (check_name, {"name": name}, ["a folder's name without a path", repr(name)])
            for name in ("", ".", "..", "a/b", ".hidden", "-x", "a\nb")
        ),
    ],
)
def test_impossible_runs_options_and_names_are_refused(make, values, words):
    assert_refused(words, make, **values)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ({}, {"iterations": 999, "stop_when_solved": 0.5}, None),
        ({}, {"max_transitions": 10**6}, None),
        ({}, {"env_id": "base"}, None),
        ({}, {"env_id": "sy"}, ["env_id=TrapTube-v0, not SymbolicTrapTube-v0"]),
        ({}, {"hidden": 8}, ["hidden=64, not 8", "iterations, max_transitions, stop_when_solved"]),
        ({"lr_decay_fraction": 0.5}, {"iterations": 999}, ["=250, not 999; max_transitions"]),
        ({"intrinsic_coef_init": 3.0}, {"iterations": 999}, ["iterations=250, not 999"]),
        ({"intrinsic_coef_init": 3.0, "curiosity": "none"}, {"iterations": 999}, None),
        ({"intrinsic_coef_init": 3.0, "intrinsic_anneal_fraction": 0}, {"iterations": 999}, None),
    ],
)
def test_only_the_end_of_a_run_may_change(before, after, words):
    old = Run(Config(**before))
    new = Run(Config(**before, **after))
    given = Path("x"), (old, RunOptions()), (new, RunOptions())
    if words is None:
        check_continues(*given)
    else:
        assert_refused(words, check_continues, *given)


def test_a_folder_holds_a_run_and_its_options(tmp_path):
    run = Run(Config(hidden=8))
    options = RunOptions(test_tasks=5, sets=("base",))
    RunFolder(tmp_path / "x").path.mkdir()
    RunFolder(tmp_path / "x").write_config(run, options)
    assert RunFolder(tmp_path / "x").read() == (run, options)
    assert_refused(["none holds no run; runs in", "x"], RunFolder(tmp_path / "none").read)


def test_a_folder_has_its_title_however_its_path_is_given(tmp_path, monkeypatch):
    (tmp_path / "x" / "y").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "x")
    for path in (".", "../x", "y/..", tmp_path / "x"):
        assert RunFolder(path).title == "x"


def test_a_second_writer_is_refused(tmp_path):
    with lock_folder(tmp_path / "x"):
        words = [f"{tmp_path}/x is being written by another process"]
        assert_refused(words, lock_folder(tmp_path / "x").__enter__)
    with pytest.raises(NotImplementedError), lock_folder(tmp_path / "x"):
        raise NotImplementedError  # an error under the lock is not the lock's
    with lock_folder(tmp_path / "x"):
        pass


def test_a_run_that_is_not_found_is_answered_with_those_near(tmp_path, monkeypatch):
    for name in ("mine", "yours"):
        RunFolder(tmp_path / "runs" / name).path.mkdir(parents=True)
        RunFolder(tmp_path / "runs" / name).write_config(Run(Config()))
    monkeypatch.chdir(tmp_path)
    for path, words in (
        ("mine", "did you mean runs/mine?"),
        ("runs/yuors", "did you mean runs/yours?"),
        ("runs", "give one of its runs: mine, yours"),
        ("runs/quite-another", "runs in runs: mine, yours"),
    ):
        assert_refused([f"{path} holds no run; {words}"], RunFolder(Path(path)).read)


def test_files_are_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "new" / "x.json"
    write = Path.write_bytes
    write_json(path, {"a": [1, 2]})

    def fill_the_disk(self, content):
        write(self, content[:3])
        raise OSError("No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fill_the_disk)
    with pytest.raises(OSError, match="No space left"):
        write_json(path, {"a": 3})
    assert read_json(path) == {"a": [1, 2]}
    assert list(path.parent.iterdir()) == [path]
