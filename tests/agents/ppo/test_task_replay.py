"""Failed tasks are played again, those failed more often apart, until newer ones overwrite them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.ppo.task_replay import TaskReplay
from helpers.trees import bits

LISTS = 2
CAPACITY = 5


@pytest.fixture
def replay() -> TaskReplay:
    return TaskReplay.untried(jax.random.key(0), LISTS, CAPACITY)


def test_newer_failures_replace_the_oldest(replay):
    keys = jax.random.split(jax.random.key(1), 6)
    last = bits(keys[5])
    for pair in jax.random.clone(keys).reshape(3, 2):
        replay = replay.remember(pair, jnp.array([True, True]), (0, 0))
    assert int(replay.next[0]) == 6 % CAPACITY
    np.testing.assert_array_equal(bits(replay.keys)[0, 0], last)


def test_of_more_failures_than_fit_the_last_are_kept(replay):
    keys = jax.random.split(jax.random.key(1), 2 * CAPACITY + 3)
    failed = jnp.ones(len(keys), bool).at[-2].set(False)
    new = bits(keys)
    after = replay.remember(keys, failed, (0, 0))
    kept = [*new[-CAPACITY - 1 : -2], new[-1]]
    assert {tuple(key) for key in bits(after.keys)[0]} == {tuple(key) for key in kept}
    assert int(after.next[0]) == len(keys[:-1]) % CAPACITY


@pytest.mark.parametrize(
    "key", [jax.random.key(0, impl="rbg"), jax.random.PRNGKey(0)], ids=["rbg", "raw"]
)
def test_task_replay_remembers_keys_of_any_kind(key):
    replay = TaskReplay.untried(jax.random.clone(key), LISTS, CAPACITY)
    drawn = replay.draw(jax.random.clone(key), (2, 2))
    after = replay.remember(drawn, jnp.ones(4, bool), (2, 2))
    assert after.keys.dtype == replay.keys.dtype
    np.testing.assert_array_equal(bits(after.keys)[1, :2], bits(drawn)[:2])


def test_tasks_are_drawn_from_all_of_their_list_and_no_other(replay):
    drawn = bits(replay.draw(jax.random.key(1), (300, 200)))
    for part, keys in zip((drawn[:300], drawn[300:]), bits(replay.keys), strict=True):
        assert {tuple(key) for key in part} == {tuple(key) for key in keys}


def test_a_list_takes_over_the_failures_of_the_list_before():
    replay = TaskReplay.untried(jax.random.key(0), 3, CAPACITY)
    keys = jax.random.split(jax.random.key(1), 10)
    played = bits(keys)
    after = replay.remember(keys, jnp.ones(10, bool), (1, 2, 3))
    assert after.next.tolist() == [4, 1, 2]
    for row, part in zip(bits(after.keys), (played[:4], played[4:5], played[5:7]), strict=True):
        np.testing.assert_array_equal(row[: len(part)], part)
