"""The environment's benchmarks run, and their figures belong together."""

import dataclasses
import json
import re
import runpy
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest
import tyro

from agents.experiments import records
from benchmarks import (
    env_throughput,
    harness,
    peers,
    train_throughput,
)
from paths import ROOT
from timings import TIMING
from trap_tube_jax.vector import VectorState
from trap_tube_jax.wrappers import AutoResetState


def test_measures_the_fast_path_and_writes_a_record(tmp_path, monkeypatch, timed):
    monkeypatch.setattr(harness, "copy_bandwidth", lambda: 1e9)
    monkeypatch.setattr(records, "machine", lambda: {"commit": "abc"})
    path = tmp_path / "results" / "env.json"
    arguments = env_throughput.Arguments(
        sets=("base",), num_envs=(2,), num_steps=2, repeats=1, json=path
    )
    (result,) = env_throughput.main(arguments)
    record = records.read_record(path, harness.SCHEMA)
    assert (record["schema"], record["benchmark"]) == (harness.SCHEMA, "env_throughput")
    command = "python -m benchmarks.env_throughput --sets base --num-envs 2 --num-steps 2"
    assert record["command"] == f"{command} --repeats 1"
    assert record["machines"][0]["jax"] == jax.__version__
    assert record["results"][0]["name"] == "base"
    assert result.observation_bytes == 12 * 12 * 3
    assert (result.steps_per_s, result.timing) == (2 * 2 / 2.0, TIMING)


@pytest.mark.parametrize(("plain", "kept"), [(False, VectorState), (True, AutoResetState)])
def test_plain_measures_what_the_fast_path_is_compared_with(monkeypatch, plain, kept):
    subjects = []

    def measure_throughput(subject, num_envs, **options):
        subjects.append(subject)
        return harness.Throughput(subject.name, num_envs, 1, 1, 1.0, 1, TIMING)

    monkeypatch.setattr(harness, "copy_bandwidth", lambda: 1e9)
    monkeypatch.setattr(harness, "measure_throughput", measure_throughput)
    env_throughput.main(env_throughput.Arguments(sets=("base",), num_envs=(2,), plain=plain))
    (subject,) = subjects
    state, _ = jax.eval_shape(subject.reset, jax.random.split(jax.random.key(0), 2))
    assert type(state) is kept


@pytest.mark.parametrize(
    ("dtype", "values", "folded"),
    [
        (jnp.uint8, (1, 2, 3, 4), 1 ^ 2 ^ 3 ^ 4),
        (jnp.float32, (1, 2, 3, 4), 0x3F800000 ^ 0x40000000 ^ 0x40400000 ^ 0x40800000),
        (jnp.bool_, (1, 1, 1, 0), 1),
    ],
)
def test_consumes_every_observation_of_any_dtype(timed, dtype, values, folded):
    observed = jnp.array((0, *values), dtype)

    def observe(count):
        return count, jnp.broadcast_to(observed[count][:, None], (len(count), 3))

    subject = harness.Subject(
        "counter",
        reset=lambda keys: observe(jnp.zeros(len(keys), jnp.int32)),
        step=lambda count, actions: observe(count + actions),
        sample_actions=lambda key, shape: jnp.ones(shape, jnp.int32),
    )
    result = harness.measure_throughput(subject, 2, num_steps=4)
    assert result.observation_bytes == 3 * jnp.dtype(dtype).itemsize
    assert timed[0].tolist() == [[[folded] * 3] * 2], "on one device, in two environments"


def test_a_measurement_is_a_first_call_and_the_repeats(monkeypatch):
    called, clock = [], iter([0, 9, 10, 12, 20, 21, 30, 33])
    monkeypatch.setattr(harness, "time", SimpleNamespace(perf_counter=clock.__next__))
    assert harness.measure(lambda: called.append(1), repeats=3) == TIMING
    assert len(called) == 1 + 3


def test_copied_bytes_are_those_of_all_passes(timed):
    assert harness.copy_bandwidth(num_bytes=16, passes=3) == 3 * 16 / 2.0
    assert timed[0].tolist() == [0 ^ 1 ^ 2] * 4


@pytest.mark.parametrize(
    ("module", "option"),
    [(module, "--json") for module in (env_throughput, peers, train_throughput)],
)
def test_what_uncommitted_code_would_measure_is_not_recorded(
    capsys, tmp_path, monkeypatch, module, option
):
    def fail(*args, **kwargs):
        raise AssertionError("began before the check")

    monkeypatch.setattr(harness, "measure", fail)
    monkeypatch.setattr(harness, "use_devices", lambda number: None)
    monkeypatch.setattr(records, "machine", lambda: {"commit": "abc-dirty"})
    monkeypatch.setattr(sys, "argv", ["x", option, str(tmp_path / "x.json")])
    with pytest.raises(SystemExit):
        runpy.run_path(module.__file__, run_name="__main__")
    assert "committed code, this one of abc-dirty" in capsys.readouterr().err
    with pytest.raises(ValueError, match="this one of abc-dirty"):  # changed while measuring
        harness.write_record(tmp_path / "x.json", "x", env_throughput.Arguments(), [])
    assert not list(tmp_path.iterdir())


def test_a_command_names_what_is_not_usual():
    options = env_throughput.Arguments(num_envs=(4, 8), plain=True, json=Path("x.json"))
    command = harness.command("env_throughput", options)
    assert command == "python -m benchmarks.env_throughput --num-envs 4 8 --plain"
    given = tyro.cli(env_throughput.Arguments, args=shlex.split(command)[3:])
    assert given == dataclasses.replace(options, json=None)


def test_recorded_commands_can_be_given():
    for path in (ROOT / "benchmarks" / "results").glob("*.json"):
        record = json.loads(path.read_text())
        if record["schema"] == harness.SCHEMA:
            name = record["benchmark"]
            options = sys.modules[f"benchmarks.{name}"].Arguments
            words = shlex.split(record["command"])
            assert words[:3] == ["python", "-m", f"benchmarks.{name}"]
            tyro.cli(options, args=words[3:])
            assert re.fullmatch("[0-9a-f]{12}", record["machines"][0]["commit"])


def test_a_peer_that_is_not_installed_is_skipped_with_its_reason(monkeypatch):
    def fail():
        raise ImportError("no such package")

    def crash():
        raise ValueError("broken")

    monkeypatch.setattr(peers, "PEERS", (("absent", fail), ("present", crash)))
    results, skipped = peers.run(peers.Arguments(num_envs=2, num_steps=1, repeats=1, sets=()))
    assert results == []
    assert skipped == {
        "absent": "ImportError: no such package (pip install 'trap-tube-jax[bench]')",
        "present": "ValueError: broken",
    }


def test_an_unknown_set_of_our_own_is_no_peer_to_skip():
    with pytest.raises(ValueError, match="unknown task set 'typo'"):
        peers.run(peers.Arguments(sets=("typo",)))


@pytest.mark.parametrize(
    ("module", "option"),
    [
        (env_throughput, "--sets"),
        (peers, "--sets"),
        (train_throughput, "--env"),
    ],
)
def test_an_unknown_set_ends_in_one_line(capsys, monkeypatch, module, option):
    monkeypatch.setattr(sys, "argv", ["x", option, "typo"])
    with pytest.raises(SystemExit) as exit_info:
        runpy.run_path(module.__file__, run_name="__main__")
    assert exit_info.value.code == 2
    assert capsys.readouterr().err.startswith("error: unknown task set 'typo'; allowed: ")


@pytest.mark.parametrize(
    ("module", "arguments", "message"),
    [
        *(
            (module, (f"--{name.replace('_', '-')}", "0"), f"{name} must be an integer >= 1, got 0")
            for module in (env_throughput, peers)
            for name in ("num_envs", "num_steps", "repeats", "devices")
        ),
        (
            env_throughput,
            ("--num-envs", "4", "3", "--devices", "2"),
            "num_envs must be multiples of devices=2, got 3",
        ),
        (
            peers,
            ("--num-envs", "3", "--devices", "2"),
            "num_envs must be multiples of devices=2, got 3",
        ),
        (train_throughput, ("--repeats", "0"), "repeats must be an integer >= 1, got 0"),
        (train_throughput, ("--warm", "-1"), "warm must be an integer >= 0, got -1"),
    ],
)
def test_a_number_that_cannot_be_is_refused_before_measuring(
    capsys, monkeypatch, module, arguments, message
):
    def fail(*args, **kwargs):
        raise AssertionError("began before the check")

    monkeypatch.setattr(harness, "measure", fail)
    monkeypatch.setattr(harness, "machine", fail)
    monkeypatch.setattr(sys, "argv", ["x", *arguments])
    with pytest.raises(SystemExit) as exit_info:
        runpy.run_path(module.__file__, run_name="__main__")
    assert exit_info.value.code == 2
    assert capsys.readouterr().err == f"error: {message}\n"


def test_the_sizes_by_default_divide_over_two_devices():
    harness.check_counts(env_throughput.Arguments().num_envs, devices=2)
    harness.check_counts((peers.Arguments().num_envs,), devices=2)


def test_more_devices_than_accelerators_are_refused(monkeypatch):
    monkeypatch.setattr(jax.config, "update", lambda *setting: None)
    with pytest.raises(ValueError, match="devices must be at most 1, as many as there are, got 2"):
        harness.use_devices(2)


def test_compiling_is_what_the_first_call_took_more():
    assert TIMING.compile_s == 9 - 2
