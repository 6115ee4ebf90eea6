"""The benchmarks of training measure what they say."""

import dataclasses
import json
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import pytest

from agents import Config
from agents.experiments import figures, records
from agents.networks.agent import Agent
from agents.ppo.learner import Learner
from benchmarks import harness, scaling, scaling_model, tables, train_throughput
from benchmarks.scaling_model import Exchange
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


def test_what_every_device_repeats_is_run_and_timed(timed):
    assert scaling_model.repeated_seconds(CONFIG) == 2.0
    assert len(timed) == 1


class Count(NamedTuple):
    """The state of a learner that only counts."""

    seed: jax.Array
    transitions: jax.Array


def counting_learner(config):
    """An iteration takes as many transitions as episodes from seed 0, from seed n 1 + n times."""

    def init(key):
        return Count(jax.random.key_data(key)[-1], jnp.uint32(0))

    def iterate(state):
        played = config.episodes_per_iteration * (1 + state.seed)
        return Count(state.seed, state.transitions + played), {}

    return SimpleNamespace(init=init, iterate=iterate)


@pytest.mark.parametrize(
    ("kind", "size", "transitions"), [("episodes", 64, 64), ("seeds", 3, 256 * (1 + 2 + 3))]
)
def test_the_speed_of_training_is_that_of_all_seeds(monkeypatch, timed, kind, size, transitions):
    monkeypatch.setattr(scaling, "make_train", counting_learner)
    monkeypatch.setattr(scaling, "peak_bytes", lambda: 7)
    point = scaling.measure(kind, "base", size)
    assert point == scaling.Point(kind, "base", size, transitions / 2.0, 7, 9.0 - 2.0)


def test_a_share_is_of_the_episodes_and_of_every_minibatch(monkeypatch, timed):
    shares = []

    def make_train(config):
        shares.append(config)
        return counting_learner(config)

    monkeypatch.setattr(scaling_model, "make_train", make_train)
    assert scaling_model.share_seconds(CONFIG, 2) == 2.0
    assert shares == [dataclasses.replace(CONFIG, episodes_per_iteration=2, minibatch_size=1)]
    assert timed[0][0].transitions == 2


def test_the_speed_up_is_that_of_the_model(monkeypatch):
    """8 s of work, 1 s that all repeat, and one all-reduce of a second and 0.25 s a step."""
    monkeypatch.setattr(scaling_model, "repeated_seconds", lambda config: 1.0)
    monkeypatch.setattr(scaling_model, "share_seconds", lambda config, devices: 8.0 / devices)
    options = scaling_model.Options(latency=0.25, bandwidth=8.0)
    config = dataclasses.replace(CONFIG, minibatch_size=4)
    rows = scaling_model.speed_up_rows(options, config, [Exchange("all-reduce", 8, 1)])
    two, four = 8 / (4 + 0.5 + 1.5), 8 / (2 + 0.75 + 3)
    parts = ((8, 0, 0), (4, 0.5, 1.5), (2, 0.75, 3))
    shown = [
        dict(zip(("share_s", "repeated_s", "exchange_s"), each, strict=True)) for each in parts
    ]
    assert rows == [
        {"devices": 1, **shown[0], "one_seed": 1, "all_seeds": 1},
        {"devices": 2, **shown[1], "one_seed": two, "all_seeds": 2},
        {"devices": 4, **shown[2], "one_seed": four, "all_seeds": 4},
        {"devices": 8, "one_seed": None, "all_seeds": 8},
        {"devices": 16, "one_seed": None, "all_seeds": 8 * two},
        {"devices": 32, "one_seed": None, "all_seeds": 8 * four},
    ]


def test_exchanges_are_counted_on_as_many_devices_as_the_page_says(tmp_path, monkeypatch):
    counted = []

    def compiled_exchanges(config, devices):
        counted.append(devices)
        return [Exchange("all-reduce", 8, 3)]

    monkeypatch.setattr(harness, "use_devices", counted.append)
    monkeypatch.setattr(scaling_model, "compiled_exchanges", compiled_exchanges)
    monkeypatch.setattr(records, "machine", lambda: {"commit": "abc"})
    path = tmp_path / "scale.json"
    scaling_model.main(["--output", str(path)])
    assert counted == [8, 8]
    assert json.loads(path.read_text())["results"] == [
        {"kind": "all-reduce", "bytes": 8, "calls": 3}
    ]


def test_points_are_drawn(tmp_path):
    points = [
        scaling.Point(kind, "base", size, 1e3 * size, 2**30, 1.0)
        for kind in scaling.TITLES
        for size in (1, 8)
    ]
    record = {"results": [dataclasses.asdict(point) for point in points]}
    ((name, draw),) = scaling.drawings(record, "mine").items()
    path = tmp_path / "folder" / name
    draw(path)
    assert figures.drawn_from(path) == scaling.digest(record)
    assert tables.points(record).split("\n\n")[:2] == [
        "**environment: steps/s over environments**",
        "| environment | 1 | 8 |\n| --- | ---: | ---: |\n"
        "| base, per second | 1,000 | 8,000 |\n| base, peak memory, GiB | 1.00 | 1.00 |",
    ]
