"""Results are found in folders: every run once, whatever links."""

import os
from pathlib import Path

import pytest

import agents
from agents.runs import provenance
from agents.runs import results as module
from agents.runs.folder import RunFolder
from agents.runs.run import Run
from helpers.refusal import assert_refused
from helpers.small_runs import stored_run
from helpers.tiny_policy import CONFIG

EVALUATION = {
    "iteration": 4, "purpose": "test", "task_set": "NA", "tasks": 2, "solved": 1,
    "layouts": "", "layouts_total": "",
}  # fmt: skip


@pytest.fixture
def runs(tmp_path) -> Path:
    """A folder of the runs a and deep/b, which have one evaluation."""
    for name in ("a", "deep/b"):
        stored_run(tmp_path / "runs" / name, Run(CONFIG), evaluations=[EVALUATION])
    return tmp_path / "runs"


def test_a_run_counts_once_whatever_links_lead_to_it(runs):
    (runs / "0-latest").symlink_to("a")
    (runs / "deep" / "up").symlink_to("..")
    expected = [str(runs / "a"), str(runs / "deep" / "b")]
    assert agents.results(runs)["run"].tolist() == expected
    assert agents.results([runs, runs / "a", runs / "0-latest"])["run"].tolist() == expected
    assert agents.results(runs / "0-latest")["task_set"].tolist() == ["NA"]
    (runs / "a").rename(runs.parent / "elsewhere")
    (runs / "a").symlink_to(runs.parent / "elsewhere")
    assert len(agents.results(runs)) == 2


def test_a_result_has_the_newest_commit_that_trained_its_run(runs, monkeypatch):
    for name in ("older", "newest"):
        monkeypatch.setattr(provenance, "commit", lambda name=name: name)
        provenance.note_provenance(RunFolder(runs / "a").provenance, "cpu")
    assert agents.results(runs / "a")["commit"].tolist() == ["newest"]


def test_a_folder_that_cannot_be_read_is_an_error(runs, monkeypatch):
    scan = os.scandir

    def denied(path):
        if Path(path).name == "deep":
            raise PermissionError(f"Permission denied: {path}")
        return scan(path)

    monkeypatch.setattr(os, "scandir", denied)
    with pytest.raises(PermissionError, match="deep"):
        agents.results(runs)


def test_a_folder_without_runs_is_refused_and_near_ones_are_named(runs, monkeypatch):
    monkeypatch.chdir(runs.parent)
    assert_refused(["none holds no run; runs in .: none"], agents.results, "none")
    assert_refused(["a holds no run; did you mean runs/a?"], agents.results, "a")
    assert_refused(["at least one folder"], agents.results, [])


def test_a_leading_tilde_is_the_home_folder_for_every_path(runs, monkeypatch):
    monkeypatch.setenv("HOME", str(runs.parent))
    assert len(agents.results("~/runs")) == 2
    assert module.find_runs(["~/runs/a"])[0].path == runs / "a"
    assert RunFolder("~/runs/a").read()[0].config == CONFIG
    with pytest.raises(ValueError, match="cannot be expanded"):
        RunFolder("~nobody-has-this-name/x")
