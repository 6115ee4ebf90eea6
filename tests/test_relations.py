"""What the relational encoder is told of a board."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.network import relations, space_to_depth
from trap_tube_jax.objects import AGENT, FOOD


@pytest.fixture(scope="module")
def tasks() -> tt.State:
    env = tt.make("psy")
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(3), 32))[0]


def test_relations_are_what_they_say(tasks):
    boards = jax.vmap(tt.observe)(tasks)
    found = np.asarray(relations(boards))
    for board, relation, agent, food in zip(
        np.asarray(boards), found, np.asarray(tasks.agent), np.asarray(tasks.food), strict=True
    ):
        same = (board[:, :, None, None] == board[None, None]).all(axis=-1)
        count = same.sum(axis=(2, 3))
        np.testing.assert_allclose(relation[..., 0], 2 * np.log(count) / np.log(144) - 1, atol=1e-6)
        right, below = np.full((12, 12), -1.0), np.full((12, 12), -1.0)
        right[:, :-1] = 2.0 * (board[:, 1:] == board[:, :-1]).all(axis=-1) - 1
        below[:-1] = 2.0 * (board[1:] == board[:-1]).all(axis=-1) - 1
        np.testing.assert_array_equal(relation[..., 1], right)
        np.testing.assert_array_equal(relation[..., 2], below)
        for channel, cell in ((3, agent), (5, food)):
            palette = np.asarray(tt.base_state().palette)
            if (board[tuple(cell)] == palette[AGENT if channel == 3 else FOOD]).all():
                offset = (np.indices((12, 12)) - cell[:, None, None]) / 11
                np.testing.assert_allclose(relation[..., channel], offset[0], atol=1e-6)
                np.testing.assert_allclose(relation[..., channel + 1], offset[1], atol=1e-6)


def test_relations_do_not_depend_on_colours(tasks):
    keys = jax.random.split(jax.random.key(4), 32)
    recolored = jax.vmap(tt.structural)(keys, tasks)
    before = np.asarray(relations(jax.vmap(tt.observe)(tasks)))
    after = np.asarray(relations(jax.vmap(tt.observe)(recolored)))
    # A symbolic swap of colours splits what the structural transfer paints alike: 1 in 5 tasks
    # stays the same at least.
    same = (before == after).all(axis=(1, 2, 3))
    assert same.sum() >= 3
    assert (before[..., 3:] == after[..., 3:]).all()


def test_what_cannot_be_seen_is_nowhere():
    board = jnp.zeros((1, 12, 12, 3), jnp.uint8)
    np.testing.assert_array_equal(relations(board)[..., 3:], 0.0)


def test_any_number_of_features_will_do():
    state = tt.base_state(5)
    found = relations(tt.observe(state)[None])[0]
    assert found.shape == (12, 12, 7)
    assert (found[9, 1, 3:5] == 0).all()


def test_blocks_of_cells_are_stacked():
    board = jnp.arange(2 * 4 * 6 * 3.0).reshape(2, 4, 6, 3)
    stacked = np.asarray(space_to_depth(board))
    assert stacked.shape == (2, 2, 3, 12)
    expected = np.asarray(board)[1, 2:4, 4:6].reshape(-1)
    np.testing.assert_array_equal(stacked[1, 1, 2], expected)
