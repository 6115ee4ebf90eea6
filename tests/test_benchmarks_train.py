"""The benchmarks of training measure what they say."""

import jax
import jax.numpy as jnp
import pytest

from agents import Config
from agents.networks.agent import Agent
from benchmarks import harness, scaling, scaling_model, train_throughput

CONFIG = Config(
    max_steps=4, episodes=4, minibatch=2, epochs=2, filters=(2, 3), hidden=4, embedding=2, chunk=4
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
def test_an_iteration_is_split_into_its_parts():
    parts = train_throughput.measure(CONFIG, warm=0, repeats=1)
    assert [part.name for part in parts] == [
        "iteration", "rollout", "encoder", "recurrent part and heads", "optimiser",
    ]  # fmt: skip
    whole, play, encoder, core, optimiser = parts
    assert whole.flop == play.flop + encoder.flop + core.flop
    assert encoder.flop > play.flop > core.flop > 0
    assert optimiser.flop == 0
    assert all(part.env == "base" for part in parts)


def test_what_every_device_repeats_is_run_and_timed(monkeypatch):
    timing = harness.Timing(first_s=9.0, median_s=2.0, fastest_s=1.0, slowest_s=3.0)
    monkeypatch.setattr(harness, "measure", lambda function, repeats: (function(), timing)[1])
    assert scaling_model.repeated_seconds(CONFIG, repeats=1) == 2.0


def test_points_are_drawn(tmp_path):
    points = [
        scaling.Point(kind, "base", size, 1e3 * size, 2**30, 1.0)
        for kind in scaling.TITLES
        for size in (1, 8)
    ]
    path = tmp_path / "folder" / "scaling.png"
    scaling.save_figure(points, path)
    assert path.read_bytes().startswith(b"\x89PNG")
