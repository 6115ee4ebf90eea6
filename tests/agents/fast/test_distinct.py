"""The fast path against the plain one: the same episodes, loss and gradient."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import make_learner
from agents.acting.encoding import Encoding
from agents.acting.rollout import rollout
from agents.fast import FastEncoding, chunks, distinct
from agents.ppo.learner import Learner
from helpers.small_runs import small_config
from trap_tube_jax.positions import layout_rows

BATCH = 12


def paths(**settings: Any) -> tuple[Learner, Learner]:
    """Returns a learner with the plain path, and one with the fast path."""
    learner = make_learner(small_config(**settings))
    parts = learner.agent, learner.curiosity.encode
    return tuple(
        dataclasses.replace(learner, encoding=kind(*parts)) for kind in (Encoding, FastEncoding)
    )  # pyright: ignore


@pytest.mark.parametrize(
    ("curiosity", "encoder"),
    [
        pytest.param("icm", "paper", marks=pytest.mark.slow),
        ("effects", "objects"),
        pytest.param("rnd", "paper", marks=pytest.mark.slow),
    ],
)
def test_both_paths_play_the_same_episodes_and_have_the_same_loss_and_gradient(curiosity, encoder):
    plain, fast = paths(env_id="psy", curiosity=curiosity, encoder=encoder)
    state = plain.init(jax.random.key(4))

    def learn(learner: Learner) -> Any:
        trajectory = learner.play(
            state.params, jax.random.split(jax.random.key(5), 8), jax.random.key(6)
        )
        reward, _ = learner.intrinsic_reward(state, trajectory)
        batch, _ = learner.make_batch(state, trajectory, reward)
        loss = jax.value_and_grad(lambda params: learner.loss(params, batch)[0])
        return trajectory.episodes, trajectory.value, reward, loss(state.params)

    (episodes, *want), (fast_episodes, *got) = (
        jax.jit(learn, static_argnums=0)(learner) for learner in (plain, fast)
    )
    jax.tree.map(np.testing.assert_array_equal, fast_episodes, episodes)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), got, want)


def test_a_cpu_takes_the_fast_path():
    learner = make_learner(small_config())
    assert (learner.encoding.name, learner.agent.core.scan_unroll) == ("fast", 1)


def test_several_seeds_in_one_program_are_encoded_as_alone():
    _, fast = paths(env_id="psy", curiosity="none", encoder="objects")
    keys = jax.random.split(jax.random.key(1), 2)
    states = jax.jit(jax.vmap(fast.init))(keys)
    episodes = fast.play(
        jax.tree.map(lambda x: x[0], states.params), keys, jax.random.key(2)
    ).episodes
    encode = jax.jit(fast.encoding.encode_episodes)
    together = jax.jit(jax.vmap(fast.encoding.encode_episodes, in_axes=(0, None)))
    found, _ = together(states.params, episodes)
    for seed in range(2):
        params = jax.tree.map(lambda x, seed=seed: x[seed], states.params)
        np.testing.assert_allclose(found[seed], encode(params, episodes)[0], rtol=1e-4, atol=1e-5)


def distinct_observations(episodes: Any) -> int:
    """Counts the pairs of layout and cells."""
    layout = np.asarray(layout_rows(episodes.layout))
    cells = np.asarray(episodes.cells)
    content = [
        np.concatenate(
            [np.broadcast_to(one, (len(steps), len(one))), steps.reshape(len(steps), -1)], 1
        )
        for one, steps in zip(layout, cells, strict=True)
    ]
    return len(np.unique(np.concatenate(content), axis=0))


@pytest.mark.parametrize("bits", [0, 20])
def test_every_distinct_observation_is_encoded_once(bits, monkeypatch):
    """Across episodes and times; where hashes collide it may be more often, to the same result."""
    monkeypatch.setattr(distinct, "CACHE_BITS", bits)
    monkeypatch.setattr(distinct, "CHUNK", 4)
    counts = []
    map_rows = chunks.map_rows

    def counting(fn: Any, chunk: int, params: Any, rows: Any, count: jax.Array) -> Any:
        jax.debug.callback(lambda count: counts.append(int(count)), count)
        return map_rows(fn, chunk, params, rows, count)

    monkeypatch.setattr(chunks, "map_rows", counting)
    _, fast = paths(env_id="psy", curiosity="none", encoder="objects")
    params = fast.init(jax.random.key(0)).params
    play = jax.jit(
        lambda states: rollout(
            fast.agent, params, fast.env, states, jax.random.key(2), fast.encoding
        )
    )
    for env_id in ("base", "psy"):
        # Several episodes of every layout, so that they share observations.
        keys = jnp.repeat(jax.random.split(jax.random.key(1), 3), BATCH // 3)
        layouts, _ = jax.jit(jax.vmap(tt.make(env_id).reset))(keys)
        jax.effects_barrier()
        counts.clear()
        episodes = play(layouts).episodes
        jax.effects_barrier()
        count = distinct_observations(episodes)
        assert len(counts) == episodes.cells.shape[1]
        assert sum(counts) == count if bits else sum(counts) > count
