"""Failed tasks are played again, those failed more often apart, until newer ones push them out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.ppo.failures import Failures

LISTS, CAPACITY = 2, 5


@pytest.fixture
def failures() -> Failures:
    return Failures.untried(jax.random.key(0), LISTS, CAPACITY)


def test_failed_tasks_rise_by_one_list_and_take_the_oldest_places(failures):
    keys = jax.random.split(jax.random.key(1), 6)
    new = np.asarray(jax.random.key_data(keys))
    failed = jnp.array([True, False, True, True, True, True])
    # Three new tasks, two of the first list, one of the last.
    after = failures.remember(keys, failed, (2, 1))
    once, twice = np.asarray(failures.keys)
    np.testing.assert_array_equal(after.keys[0], [new[0], new[2], *once[2:]])
    np.testing.assert_array_equal(after.keys[1], [new[3], new[4], *twice[2:]])
    np.testing.assert_array_equal(after.next, [2, 2])


def test_places_are_filled_in_turn(failures):
    for seed in range(3):
        keys = jax.random.split(jax.random.key(seed), 2)
        failures = failures.remember(keys, jnp.array([True, True]), (0, 0))
    assert int(failures.next[0]) == 6 % CAPACITY
    np.testing.assert_array_equal(failures.keys[0, 0], jax.random.key_data(keys)[1])


def test_solved_tasks_stay(failures):
    keys = failures.draw(jax.random.key(1), (4, 4))
    after = failures.remember(keys, jnp.zeros(8, bool), (4, 4))
    np.testing.assert_array_equal(after.keys, failures.keys)


def test_all_that_is_remembered_is_drawn_in_its_place(failures):
    drawn = np.asarray(jax.random.key_data(failures.draw(jax.random.key(1), (300, 200))))
    for part, keys in zip((drawn[:300], drawn[300:]), np.asarray(failures.keys), strict=True):
        assert {tuple(key) for key in part} == {tuple(key) for key in keys}
