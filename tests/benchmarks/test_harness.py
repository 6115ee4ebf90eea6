"""Timing, records, and the command lines of all benchmarks."""

import dataclasses
import json
import re
import runpy
import shlex
import subprocess
import sys
from types import SimpleNamespace

import jax.numpy as jnp
import pytest

from agents.command_line import parse
from benchmarks import env_throughput, harness, learner_peers, peers, seeds, train_throughput
from helpers.paths import ROOT

TIMING = harness.Timing(compile_s=7.0, median_s=2.0, fastest_s=1.0, slowest_s=3.0)
RESULTS = ROOT / "benchmarks" / "results"
MODULES = [env_throughput, peers, train_throughput, learner_peers, seeds]
OPTIONS = {
    "env_throughput": env_throughput.Options,
    "peers": peers.Options,
    "train_throughput": train_throughput.Options,
    "learner_peers": learner_peers.Options,
    "seeds": seeds.Options,
}


def test_timing_separates_compilation_from_calls_and_leaves_out_the_first(monkeypatch):
    clock = iter([0, 7, 10, 99, 100, 102, 110, 111, 120, 123])
    monkeypatch.setattr(harness, "time", SimpleNamespace(perf_counter=clock.__next__))
    assert harness.measure(jnp.sin, jnp.ones(()), repeats=3) == TIMING


def test_a_record_names_command_machine_and_results(tmp_path, monkeypatch):
    monkeypatch.setattr(harness, "commit", lambda: "abc")
    monkeypatch.setattr(harness, "provenance", lambda: {"commit": "abc"})
    options = env_throughput.Options(num_envs=(4, 8), plain=True, output=tmp_path / "a" / "b.json")
    harness.write_record("env_throughput", options, [TIMING], more=1)
    record = json.loads((tmp_path / "a" / "b.json").read_text())
    assert (record["benchmark"], record["more"]) == ("env_throughput", 1)
    assert record["machine"] == {"commit": "abc", "devices": 1}
    assert record["results"] == [dataclasses.asdict(TIMING)]
    assert record["command"] == "python -m benchmarks.env_throughput --num-envs 4 8 --plain"
    given = parse(env_throughput.Options, shlex.split(record["command"])[3:], "")
    assert given == dataclasses.replace(options, output=None)


def test_recorded_commands_can_be_given():
    records = [json.loads(path.read_text()) for path in RESULTS.glob("*.json")]
    records = [record for record in records if record.get("schema") == harness.SCHEMA]
    assert records
    for record in records:
        words = shlex.split(record["command"])
        assert words[:3] == ["python", "-m", f"benchmarks.{record['benchmark']}"]
        parse(OPTIONS[record["benchmark"]], words[3:], "")
        assert re.fullmatch("[0-9a-f]{12}", record["machine"]["commit"])
        assert all(result["timing"]["compile_s"] > 0 for result in record["results"])


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        (env_throughput, ("--num-steps", "0"), "num_steps must be an integer >= 1, got 0"),
        (env_throughput, ("--num-envs", "4", "0"), "num_envs must be an integer >= 1, got 0"),
        (peers, ("--num-envs", "3", "--devices", "2"), "num_envs must be multiples of devices=2"),
        (seeds, ("--seeds", "1", "0"), "seeds must be an integer >= 1, got 0"),
        (seeds, ("--iterations", "0"), "iterations must be an integer >= 1, got 0"),
        (seeds, ("--repeats", "0"), "repeats must be an integer >= 1"),
        (peers, ("--output", "."), "output must be a file, and . is a folder"),
        *((module, ("--output", "x"), "a record needs committed code") for module in MODULES),
        *((module, ("--sets", "typo"), "unknown task set 'typo'; allowed: ") for module in MODULES),
    ],
)
def test_a_wrong_option_ends_in_one_line_before_measuring(
    capsys, monkeypatch, module, arguments, message
):
    def fail(*args, **kwargs):
        raise AssertionError("began before the check")

    monkeypatch.setattr(harness, "compiled", fail)
    monkeypatch.setattr(harness, "commit", lambda: "abc-dirty")
    monkeypatch.setattr(harness, "run_command", lambda main: main())  # signals stay pytest's
    monkeypatch.setattr(sys, "argv", ["x", *arguments])
    with pytest.raises(SystemExit) as stopped:
        runpy.run_path(module.__file__, run_name="__main__")
    error = capsys.readouterr().err
    assert (stopped.value.code, error.count("\n")) == (2, 1)
    assert error.startswith(f"error: {message}")


def results_of(name):
    record = json.loads((RESULTS / f"{name}.json").read_text())
    return record["machine"]["commit"][:7], record["results"]


def test_stated_speeds_are_of_their_records():
    """A table marked `<!-- speeds: NAME NAME -->` has a row per batch size of a record."""
    page = (RESULTS / "throughput.md").read_text()
    tables = re.findall(r"<!-- speeds: (.*?) -->\n\n(.*?)\n\n", page, re.DOTALL)
    assert len(tables) == 2
    for names, table in tables:
        head, _, *rows = [line.strip("| ").split(" | ") for line in table.splitlines()]
        shown = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
        for commit, results in map(results_of, names.split()):
            for result in results:
                if result["num_envs"] >= 4096:
                    devices = f"{result['devices']} device" + "s" * (result["devices"] > 1)
                    row = f"{devices}, {result['num_envs']:,} environments, commit `{commit}`"
                    assert shown[row][result["name"]] == f"{result['steps_per_s'] / 1e6:.1f}"
    stated = [line.strip("| ").split(" | ") for line in page.splitlines()]
    parts = [results_of(f"train_throughput_{name}")[1] for name in ("base", "pstsy")]
    for base, pstsy in zip(*parts, strict=True):
        seconds = [f"{result['timing']['median_s']:.1f}" for result in (base, pstsy)]
        assert any(row[0].startswith(base["name"]) and row[1:] == seconds for row in stated)
    readme = (ROOT / "README.md").read_text()
    (sentence,) = re.findall(r"^\*\*Speed\*\*.*?\n\n", readme, re.MULTILINE | re.DOTALL)
    commit, results = results_of("peers_2_devices")
    assert f"Commit `{commit}`" in sentence
    speeds = re.findall(r"\b(\d+\.\d)\b", sentence)
    assert set(speeds) == {f"{result['steps_per_s'] / 1e6:.1f}" for result in results}


def test_the_cpu_is_split_before_jax_starts():
    command = "--sets base --num-envs 4 --num-steps 2 --repeats 1 --devices 2"
    words = [sys.executable, "-m", "benchmarks.env_throughput", *command.split()]
    shown = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "'devices': 2" in shown
