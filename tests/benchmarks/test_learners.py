"""Throughput of training: parts, and the plain program next to ours."""

import dataclasses
import importlib
import os
import sys
from collections.abc import Mapping

import pytest

from agents import Config
from agents.command_line import parse
from benchmarks import accelerator, learner_peers, seeds, train_throughput
from helpers.refusal import assert_refused
from trap_tube_jax.interruptions import Stopped

TINY = {"filters": (2, 3), "hidden": 4, "embedding": 2}
CONFIG = Config(max_steps=4, episodes_per_iteration=4, minibatch_size=2, epochs=2, **TINY)
STEPS = 4 * 4  # of an iteration


@pytest.mark.slow
def test_an_iteration_is_split_into_its_parts(timed):
    parts = train_throughput.measure(CONFIG, warm=1, repeats=3)
    names = ["iteration", "rollout", "encoder", "recurrent part and heads"]
    assert [part.name for part in parts] == names
    assert {(part.task_set, part.steps_per_s) for part in parts} == {("base", STEPS / 2)}


@pytest.mark.slow
def test_all_programs_play_an_iteration(monkeypatch, timed):
    monkeypatch.setattr(learner_peers.Options, "config", lambda *given: CONFIG)
    speeds = learner_peers.measure("base", "paper", learner_peers.Options(repeats=3))
    assert [speed.program for speed in speeds] == ["ours", "plain", "plain-by-step"]
    steps = [speed.steps_per_s * speed.timing.median_s for speed in speeds]
    assert steps == pytest.approx([STEPS] * 3)


@pytest.mark.interop
@pytest.mark.filterwarnings("default")
def test_rejax_plays_as_many_steps_as_we(monkeypatch, timed):
    config = dataclasses.replace(CONFIG, **learner_peers.SETTINGS["feedforward"])
    monkeypatch.setattr(learner_peers.Options, "config", lambda *given: config)
    speeds = learner_peers.measure("base", "feedforward", learner_peers.Options(repeats=1))
    assert [speed.program for speed in speeds] == ["ours", "rejax"]
    steps = [speed.steps_per_s * speed.timing.median_s for speed in speeds]
    assert steps == pytest.approx([STEPS] * 2)


@pytest.mark.slow
def test_seeds_in_one_program_play_their_iterations(monkeypatch, timed):
    options = seeds.Options(iterations=2, repeats=3)
    for count in (1, 3):
        speed = seeds.measure(CONFIG, count, options)
        assert speed.steps_per_s * speed.timing.median_s == pytest.approx(STEPS * 2 * count)


@pytest.mark.parametrize("scale", ["MEASUREMENTS", "SMALL"])
def test_an_accelerators_measurements_are_commands_that_exist(scale, monkeypatch, capsys):
    """A failed one is named, and the others run; a second start fails with the first."""
    commands = []

    def call(command: list[str], limit: float, environ: Mapping[str, str]) -> int:
        assert not os.listdir(environ["XDG_CACHE_HOME"])
        commands.append(command)
        return int(commands.index(command) in (0, 3))

    monkeypatch.setattr(accelerator, "call", call)
    small = scale == "SMALL"
    failed = accelerator.main(accelerator.Options(small=small))
    names = list(getattr(accelerator, scale))
    skipped = [accelerator.SECOND_START] if scale == "MEASUREMENTS" else []
    assert failed == [*names[:1], *names[3:4], *skipped]
    assert len(commands) == len(names) - len(skipped)
    for _, _, module, *words in commands:
        options = importlib.import_module(module).Options
        parse(options, words, module)


def test_a_measurement_ends_with_its_exit_code_its_limit_or_the_signal():
    python = [sys.executable, "-c"]
    assert accelerator.call([*python, "raise SystemExit(3)"], 60, os.environ) == 3
    assert accelerator.call([*python, "input()"], 0, os.environ) is None
    parent = "import os, signal; os.kill(os.getppid(), signal.SIGTERM); signal.pause()"
    with pytest.raises(Stopped):
        accelerator.call([*python, parent], 60, os.environ)


def test_starts_are_measured_in_their_order(monkeypatch):
    measured = []
    monkeypatch.setattr(accelerator, "run", lambda name, *_: not measured.append(name))
    starts = (accelerator.FIRST_START, accelerator.SECOND_START)
    assert accelerator.main(accelerator.Options(only=(*reversed(starts), starts[0]))) == []
    assert measured == list(starts)


def test_networks_without_a_program_are_refused():
    options = learner_peers.Options(networks=("feedforward",), programs=("plain",))
    assert_refused(["network feedforward", "allowed: ours, rejax"], learner_peers.main, options)


def test_an_unknown_measurement_is_refused():
    with pytest.raises(ValueError, match=r"no measurement 'gpu'; allowed: gpu_paper"):
        accelerator.main(accelerator.Options(only=("gpu",)))
    with pytest.raises(ValueError, match="gpu_best_second_start needs gpu_best_first_start"):
        accelerator.main(accelerator.Options(only=("gpu_best_second_start",)))
