"""Throughput of training: parts, arithmetic, and the plain program next to ours."""

import jax
import jax.numpy as jnp
import pytest

from agents import Config
from agents.networks.agent import Agent
from benchmarks import learner_peers, train_throughput

TINY = {"filters": (2, 3), "hidden": 4, "embedding": 2, "encode_chunk_size": 4}
CONFIG = Config(max_steps=4, episodes_per_iteration=4, minibatch_size=2, epochs=2, **TINY)
STEPS = 4 * 4  # of an iteration


def test_operations_of_matrix_products_are_counted():
    def function(x, y):
        def body(carry, _):
            return carry @ y, None

        return jax.lax.scan(body, jax.jit(jnp.matmul)(x, y), None, length=1)[0]

    jaxpr = jax.make_jaxpr(function)(jnp.zeros((3, 5)), jnp.zeros((5, 5)))
    assert train_throughput.matrix_flop(jaxpr) == 2 * (2 * 3 * 5 * 5)


def test_the_papers_encoder_costs_what_its_shapes_say():
    agent = Agent(Config())
    params = jax.eval_shape(agent.init, jax.random.key(0))
    board = jnp.zeros((1, 12, 12, 3), jnp.uint8)
    jaxpr = jax.make_jaxpr(agent.encoder.apply)(params["encoder"], board)
    stem = 144 * 4 * 6 * 32 + 144 * 4 * 32 * 64
    blocks = 2 * (36 + 9) * 9 * 64 * 64
    assert train_throughput.matrix_flop(jaxpr) == 2 * (stem + blocks)


@pytest.mark.slow
def test_an_iteration_is_split_into_its_parts(timed):
    parts = train_throughput.measure(CONFIG, warm=1, repeats=3)
    names = ["iteration", "rollout", "encoder", "recurrent part and heads"]
    assert [part.name for part in parts] == names
    whole, rollout, encoder, core = parts
    assert whole.flop == rollout.flop + encoder.flop + core.flop
    assert encoder.flop > rollout.flop > core.flop > 0
    assert {(part.task_set, part.steps_per_s) for part in parts} == {("base", STEPS / 2)}


@pytest.mark.slow
def test_all_programs_play_an_iteration(monkeypatch, timed):
    monkeypatch.setattr(learner_peers.Options, "config", lambda *given: CONFIG)
    speeds = learner_peers.measure("base", "paper", learner_peers.Options(repeats=3))
    assert [speed.program for speed in speeds] == ["ours", "plain", "plain-by-step"]
    steps = [speed.steps_per_s * speed.timing.median_s for speed in speeds]
    assert steps == pytest.approx([STEPS] * 3)
