"""Throughput of training: parts, and the plain program next to ours."""

import pytest

from agents import Config
from benchmarks import learner_peers, train_throughput

TINY = {"filters": (2, 3), "hidden": 4, "embedding": 2, "encode_chunk_size": 4}
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
