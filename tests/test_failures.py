"""Failed tasks are played again until newer ones push them out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.ppo.failures import Failures

CAPACITY = 5


@pytest.fixture
def failures() -> Failures:
    return Failures.untried(jax.random.key(0), CAPACITY)


def test_failed_tasks_take_the_oldest_places_in_turn(failures):
    keys = jax.random.split(jax.random.key(1), 6)
    before, new = failures.keys, np.asarray(jax.random.key_data(keys))
    failed = jnp.array([True, False, True, True, False, False])
    after = failures.remember(keys, failed)
    np.testing.assert_array_equal(after.keys, [new[0], new[2], new[3], *before[3:]])
    again = after.remember(keys, ~failed)
    np.testing.assert_array_equal(again.keys, [new[5], new[2], new[3], new[1], new[4]])
    assert int(again.next) == 1


def test_all_that_is_remembered_is_drawn(failures):
    drawn = np.asarray(jax.random.key_data(failures.draw(jax.random.key(1), 300)))
    assert {tuple(key) for key in drawn} == {tuple(key) for key in np.asarray(failures.keys)}
