"""An iteration as three compiled programs."""

import functools
import gc
import threading
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.config import Config
from agents.parallel.sharding import Placement
from agents.ppo.learner import Learner, TrainState, make_train
from agents.runs import programs
from agents.runs.programs import Programs
from agents.runs.traces import Traces

TINY = {"max_steps": 6, "filters": (2, 2), "hidden": 4, "embedding": 2, "eval_episodes": 2}
SMALL = Config(**TINY, curiosity="none", episodes=4, minibatch=2, epochs=2, chunk=4)


def test_three_programs_do_what_one_does():
    close = functools.partial(chex.assert_trees_all_close, rtol=1e-4, atol=1e-6)
    train = make_train(SMALL)
    state = jax.vmap(train.init)(jax.random.split(jax.random.key(0), 1))
    alone = jax.tree.map(lambda x: x[0].copy(), state)
    iterate, three = jax.jit(train.iterate), Programs(train, Placement(), state, np.ones(1, bool))
    for _ in range(2):
        before = alone.transitions
        alone, metrics = iterate(alone)
        state, found = three(state, np.ones(1, bool))
        expected = {
            **metrics,
            "episodes": alone.episodes,
            "evaluation": np.float32(0),
            "steps": alone.transitions - before,
            "transitions": alone.transitions,
        }
        assert list(found) == sorted(expected)
        close(found, {name: x[None] for name, x in expected.items()})
    own, others = (jax.random.key_data(key) for key in (alone.key, state.key[0]))
    np.testing.assert_array_equal(own, others)
    state, alone = (x._replace(key=None, failures=None) for x in (state, alone))
    close(state, jax.tree.map(lambda x: x[None], alone))


def test_kept_programs_train_to_the_same_bits(tmp_path, monkeypatch):
    train, active = make_train(SMALL), np.ones(1, bool)

    def trained() -> Any:
        state = jax.vmap(train.init)(jax.random.split(jax.random.key(0), 1))
        iterate = Programs(train, Placement(), state, active)
        state, _ = iterate(state, active)
        state, metrics = iterate(state, active)
        return jax.random.key_data(state.key), state._replace(key=None), metrics

    def unmade(name: str) -> Any:
        def make(_: Learner) -> Any:
            raise AssertionError(f"{name} is traced anew")

        make.__name__ = name
        return make

    expected = trained()
    monkeypatch.setattr(programs.Traces, "of", lambda config: Traces(tmp_path, bytes(32)))
    chex.assert_trees_all_equal(trained(), expected)
    never = [unmade(make.__name__) for make in programs.PHASES]
    monkeypatch.setattr(programs, "PHASES", never)
    chex.assert_trees_all_equal(trained(), expected)


def test_garbage_is_collected_afterwards_as_before():
    for was_enabled in (False, True):
        (gc.enable if was_enabled else gc.disable)()
        with programs._uncollected():
            assert not gc.isenabled()
        assert gc.isenabled() == was_enabled


def make_state(train: Learner, seeds: int) -> TrainState:
    """Zeros, with different keys."""
    keys = jax.random.split(jax.random.key(0), seeds)
    shapes = jax.eval_shape(jax.vmap(train.init), keys)
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes._replace(key=None))
    return zeros._replace(key=keys)


def test_an_iteration_begins_while_its_end_is_still_traced():
    has_played = threading.Event()

    class Waiting(Learner):
        def collect(self, state) -> Any:
            jax.debug.callback(has_played.set)
            return state, jnp.zeros(3), {}

        def learn(self, state, batch: Any):
            assert has_played.wait(60)
            return state, {}

    train = Waiting(**vars(make_train(Config(**TINY))))
    state, active = make_state(train, 1), np.ones(1, bool)
    Programs(train, Placement(), state, active)(state, active)


def test_what_fails_while_tracing_ends_the_iteration():
    class Failing(Learner):
        def learn(self, state, batch: Any) -> Any:
            raise ValueError("no loss")

    train = Failing(**vars(make_train(Config(**TINY, episodes=2, minibatch=2))))
    state, active = make_state(train, 1), np.ones(1, bool)
    with pytest.raises(ValueError, match="no loss"):
        Programs(train, Placement(), state, active)(state, active)


def test_solved_seeds_stay_as_they_are():
    """Two seeds side by side, the second one solved."""

    class Adding(Learner):
        def collect(self, state) -> Any:
            return state._replace(transitions=state.transitions + 48), jnp.arange(3.0), {}

        def learn(self, state, batch: Any):
            state = state._replace(
                params=jax.tree.map(lambda x: x + jnp.sum(batch), state.params),
                iteration=state.iteration + 1,
                episodes=state.episodes + 8,
            )
            return state, {"loss": jnp.float32(1)}

    train = Adding(**vars(make_train(Config(**TINY))))
    state = make_state(train, 2)
    active = jnp.array([True, False])
    after, metrics = Programs(train, Placement(), state, active)(state, active)
    assert after.iteration.tolist() == [1, 0]
    assert after.transitions.tolist() == [48, 0]
    assert metrics["steps"].tolist() == [48, 48]
    for leaf in jax.tree.leaves(after.params):
        assert np.all(np.asarray(leaf[0]) == 3)
        assert np.all(np.asarray(leaf[1]) == 0)
