"""The benchmarks of training measure what they say."""

import jax
import jax.numpy as jnp
import pytest

from agents import Config
from agents.networks.agent import Agent
from agents.ppo.learner import Learner
from benchmarks import harness, train_throughput
from timings import TIMING

CONFIG = Config(
    max_steps=4,
    episodes_per_iteration=4,
    minibatch_size=2,
    epochs=2,
    filters=(2, 3),
    hidden=4,
    embedding=2,
    encode_chunk_size=4,
)


def test_operations_of_matrix_products_are_counted():
    def function(x, y):
        def body(carry, _):
            return carry @ y, None

        return jax.lax.scan(body, jax.jit(jnp.matmul)(x, y), None, length=1)[0]

    jaxpr = jax.make_jaxpr(function)(jnp.zeros((3, 5)), jnp.zeros((5, 5)))
    assert train_throughput.matrix_flop(jaxpr) == 2 * (2 * 3 * 5 * 5)


def test_the_encoder_of_the_paper_costs_what_its_shapes_say():
    agent = Agent(Config())
    params = jax.eval_shape(agent.init, jax.random.key(0))
    board = jnp.zeros((1, 12, 12, 3), jnp.uint8)
    jaxpr = jax.make_jaxpr(agent.encoder.apply)(params["encoder"], board)
    stem = 144 * 4 * 6 * 32 + 144 * 4 * 32 * 64
    blocks = 2 * (36 + 9) * 9 * 64 * 64
    assert train_throughput.matrix_flop(jaxpr) == 2 * (stem + blocks)


@pytest.mark.slow
def test_an_iteration_is_split_into_its_parts(monkeypatch):
    traced, own_play = [], Learner.play

    def play(*arguments):
        traced.append("play")
        return own_play(*arguments)

    def measure(function, repeats):
        traced.append("measured")
        function()
        return TIMING

    monkeypatch.setattr(Learner, "play", play)
    monkeypatch.setattr(harness, "measure", measure)
    parts = train_throughput.measure(CONFIG, warm=1, repeats=1)
    assert [part.name for part in parts] == [
        "iteration", "rollout", "encoder", "recurrent part and heads", "optimiser",
    ]  # fmt: skip
    whole, rollout, encoder, core, optimiser = parts
    assert whole.flop == rollout.flop + encoder.flop + core.flop
    assert encoder.flop > rollout.flop > core.flop > 0
    assert optimiser.flop == 0
    assert all(part.env == "base" for part in parts)
    first = traced.index("measured")
    assert traced[first:] == ["measured", "play", "measured", "play", *3 * ["measured"]], (
        "iteration and rollout compile in their first measured call"
    )


def test_operations_of_the_large_product_are_counted(monkeypatch, timed):
    monkeypatch.setattr(train_throughput, "MATRIX", 3)
    assert train_throughput.matrix_product_flops() == 2 * 3**3 / 2.0
    assert timed[0].tolist() == [[3.0] * 3] * 3
