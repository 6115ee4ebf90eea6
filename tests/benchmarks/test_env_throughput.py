"""Throughput of environments, ours and others'."""

import functools
import itertools

import jax
import jax.numpy as jnp
import pytest

from benchmarks import env_throughput, harness, peers
from benchmarks.env_throughput import StepOptions, Subject
from trap_tube_jax import VectorState


def counter(name, *, plain=False):
    """A cheap subject that shows how often it was stepped, three times in float32."""
    del plain

    def observe(count):
        return count, jnp.broadcast_to(count.astype(jnp.float32)[:, None], (len(count), 3))

    return Subject(
        name,
        reset=lambda keys: observe(jnp.zeros(len(keys), jnp.int32)),
        step=lambda count, actions: observe(count + actions),
        sample_actions=lambda key, shape: jnp.ones(shape, jnp.int32),
    )


def test_throughput_measures_every_set_and_batch(timed, monkeypatch):
    monkeypatch.setattr(env_throughput, "task_set_subject", counter)
    options = env_throughput.Options(sets=("base", "sy"), num_envs=(2, 4), num_steps=3, repeats=3)
    results = env_throughput.main(options)
    measured = [(x.name, x.num_envs) for x in results]
    assert measured == list(itertools.product(("base", "sy"), (2, 4)))
    assert {x.observation_bytes for x in results} == {3 * 4}
    assert {x.timing for x in results} == {harness.Timing(7, 2, 1, 6)}
    assert results[1].steps_per_s == 4 * 3 / 2


def test_throughput_folds_every_observation(timed):
    options = StepOptions(num_steps=4, repeats=1)
    result = env_throughput.measure_throughput(counter("counter"), 2, options)
    assert result.observation_bytes == 3 * 4
    folded = 0x3F800000 ^ 0x40000000 ^ 0x40400000 ^ 0x40800000
    assert timed[0][1].tolist() == [[[folded] * 3] * 2], "on one device, in two environments"


@pytest.mark.parametrize("plain", [False, True])
def test_a_task_set_steps_by_the_vector_environment_or_by_vmap(plain):
    subject = env_throughput.task_set_subject("base", plain=plain)
    state, _ = jax.eval_shape(subject.reset, jax.random.split(jax.random.key(0), 2))
    actions = subject.sample_actions(jax.random.key(1), (2,))
    state, timestep = jax.eval_shape(subject.step, state, actions)
    assert isinstance(state, VectorState) != plain
    assert subject.observe(timestep).shape == (2, 12, 12, 3)


def test_peers_prints_steps_and_skips_libraries_that_fail(timed, capsys, monkeypatch):
    def absent():
        raise ImportError("no such package")

    def broken():
        raise ValueError("broken\nin two lines")

    def out_of_memory(subject, num_envs, options, measure=env_throughput.measure_throughput):
        if num_envs > 2:
            raise MemoryError("full")
        return measure(subject, num_envs, options)

    known = functools.partial(env_throughput.task_set_subject, "p")
    monkeypatch.setattr(peers, "PEERS", {"pgx": absent, "navix": broken, "jumanji": known})
    monkeypatch.setattr(harness, "machine", dict)
    size = {"num_envs": (2,), "num_steps": 4, "repeats": 3}
    peers.main(peers.Options(sets=("base",), peers=("pgx", "navix"), **size))
    *table, absent_line, broken_line = capsys.readouterr().out.splitlines()
    (cells,) = [line.strip("│").split("│") for line in table if "base" in line]
    assert [cell.strip() for cell in cells[4:6]] == ["250000.000", "432"]
    absence = "ImportError: no such package (pip install -e '.[bench]')"
    assert absent_line == f"skipped pgx, 2 envs: {absence}"
    assert broken_line == "skipped navix, 2 envs: ValueError: broken"
    monkeypatch.setattr(env_throughput, "measure_throughput", out_of_memory)
    options = peers.Options(peers=("jumanji",), **{**size, "num_envs": (2, 4)})
    results, skipped = peers.measure(options, [])
    assert [result.num_envs for result in results] == [2]
    assert skipped == {"jumanji, 4 envs": "MemoryError: full"}
