"""Throughput of environments, ours and others'."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import env_throughput, harness, peers
from benchmarks.env_throughput import PATTERNS, StepOptions, Subject


def test_measures_every_set_batch_and_pattern(timed, monkeypatch):
    monkeypatch.setattr(env_throughput, "copy_bandwidth", lambda: 1e9)
    options = env_throughput.Options(
        sets=("base", "sy"), num_envs=(2, 4), num_steps=3, repeats=3, patterns=("sum", "last")
    )
    results = env_throughput.main(options)
    measured = [(each.name, each.num_envs, each.pattern) for each in results]
    assert measured == list(itertools.product(("base", "sy"), (2, 4), ("sum", "last")))
    assert {each.observation_bytes for each in results} == {12 * 12 * 3}
    assert {each.timing for each in results} == {harness.Timing(7, 2, 1, 3)}
    assert results[2].steps_per_s == 4 * 3 / 2


def test_folds_every_observation(timed):
    observed = jnp.array((0, 1, 2, 3, 4), jnp.float32)

    def observe(count):
        return count, jnp.broadcast_to(observed[count][:, None], (len(count), 3))

    subject = Subject(
        "counter",
        reset=lambda keys: observe(jnp.zeros(len(keys), jnp.int32)),
        step=lambda count, actions: observe(count + actions),
        sample_actions=lambda key, shape: jnp.ones(shape, jnp.int32),
    )
    result = env_throughput.measure_throughput(subject, 2, StepOptions(num_steps=4, repeats=1))
    assert result.observation_bytes == 3 * 4
    folded = 0x3F800000 ^ 0x40000000 ^ 0x40400000 ^ 0x40800000
    assert timed[0][1].tolist() == [[[folded] * 3] * 2], "on one device, in two environments"


def test_patterns_compute_what_they_say():
    observations = jax.random.bits(jax.random.key(0), (4, 12, 12, 3), jnp.uint8)
    values = np.asarray(observations, np.int64)
    read = {name: np.asarray(pattern.read(observations)) for name, pattern in PATTERNS.items()}
    assert read["bytes"].tolist() == values.reshape(4, -1).tolist()
    assert read["sum"] == values.sum()
    np.testing.assert_allclose(read["mean"], values.mean(), rtol=1e-5)
    assert read["dense"].shape == (4, env_throughput.DENSE_UNITS)
    counts = [np.sum(values // 32 == level) for level in range(8)]
    assert read["one-hot"].reshape(-1, 8).sum(axis=0).tolist() == counts
    assert PATTERNS["last"].join(jnp.zeros_like(observations), observations) is observations


def test_peers_prints_time_and_size_of_a_step_and_skips_what_fails(timed, capsys, monkeypatch):
    def absent():
        raise ImportError("no such package")

    def broken():
        raise ValueError("broken\nin two lines")

    monkeypatch.setattr(peers, "PEERS", {"absent": absent, "broken": broken})
    monkeypatch.setattr(harness, "machine", dict)
    peers.main(StepOptions(sets=("base",), num_envs=(2,), num_steps=4, repeats=3))
    *table, absent_line, broken_line = capsys.readouterr().out.splitlines()
    (cells,) = [line.strip("│").split("│") for line in table if "base" in line]
    assert [cell.strip() for cell in cells[4:6]] == ["250000.000", "432"]
    assert absent_line == "skipped absent: ImportError: no such package (pip install -e '.[bench]')"
    assert broken_line == "skipped broken: ValueError: broken"
