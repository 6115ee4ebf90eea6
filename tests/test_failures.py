"""Failed tasks are played again until they are solved or pushed out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.ppo.failures import Failures

CAPACITY = 5


@pytest.fixture
def failures() -> Failures:
    return Failures.untried(jax.random.key(0), CAPACITY)


def data(keys: jax.Array) -> list[tuple[int, ...]]:
    return [tuple(key) for key in np.asarray(jax.random.key_data(keys)).tolist()]


def test_failed_tasks_take_the_oldest_places_in_turn(failures):
    keys = jax.random.split(jax.random.key(1), 6)
    before = data(failures.reset_keys(jnp.arange(CAPACITY)))
    failed = jnp.array([True, False, True, True, False, False])
    after = failures.with_new(keys, failed)
    new = data(keys)
    places = jnp.arange(CAPACITY)
    assert data(after.reset_keys(places)) == [new[0], new[2], new[3], *before[3:]]
    again = after.with_new(keys, ~failed)
    assert data(again.reset_keys(places)) == [new[5], new[2], new[3], new[1], new[4]]
    assert int(again.next) == 1


def test_solved_tasks_are_not_drawn_until_their_places_are_taken(failures):
    places, solved = jnp.array([0, 3, 3, 4]), jnp.array([True, False, True, False])
    after = failures.without(places, solved)
    drawn = np.asarray(after.draw(jax.random.key(1), 300))
    assert set(drawn.tolist()) == {1, 2, 4}
    keys = jax.random.split(jax.random.key(2), 1)
    drawn = np.asarray(after.with_new(keys, jnp.array([True])).draw(jax.random.key(1), 300))
    assert set(drawn.tolist()) == {0, 1, 2, 4}


def test_with_nothing_unsolved_all_are_drawn(failures):
    after = failures.without(jnp.arange(CAPACITY), jnp.ones(CAPACITY, bool))
    assert len(set(np.asarray(after.draw(jax.random.key(1), 300)).tolist())) == CAPACITY
