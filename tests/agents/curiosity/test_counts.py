"""Visit counts: the bonus, the table's slots, and the tasks that they are for."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.episodes import Episodes, cells_of
from agents.acting.identity import observation_ids
from agents.curiosity import counts
from agents.curiosity.counts import Counts, observation_slots, visit_bonus

BATCH, STEPS = 40, 4


@pytest.fixture(scope="module")
def episodes() -> Episodes:
    """Random play of {Sy}."""
    env = tt.make("sy", max_steps=STEPS)
    action = jax.random.randint(jax.random.key(2), (STEPS, BATCH, 2), 0, 4)

    @jax.jit
    def play():
        initial, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), BATCH))

        def step(state, action):
            state, _ = jax.vmap(env.step)(state, action)
            return state, cells_of(state)

        return initial, jax.lax.scan(step, initial, action)[1]

    initial, cells = play()
    cells = jnp.concatenate([cells_of(initial)[None], cells])
    ones = jnp.ones((STEPS, BATCH))
    return Episodes(initial, cells, action, 0 * ones, ones, ones)


@pytest.mark.parametrize("env_id", ["base", "sy", "p", "st", "pstsy"])
def test_counts_are_for_tasks_that_return(env_id):
    if env_id in ("base", "sy"):
        assert Counts(tt.make(env_id)).memory().shape == (2**20,)
    else:
        with pytest.raises(ValueError, match="'counts' needs tasks that return: base or Sy"):
            Counts(tt.make(env_id))


def test_visits_pay_by_the_root_of_their_number():
    slot = jnp.array([[3, 3], [5, 3]])
    mask = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    bonus, visits = visit_bonus(jnp.zeros(8).at[5].set(3.0), slot, mask)
    np.testing.assert_allclose(bonus, [[2**-0.5, 2**-0.5], [0.5, 0.0]], rtol=1e-6)
    np.testing.assert_array_equal(visits, [0, 0, 0, 2, 0, 4, 0, 0])


def test_few_observations_share_a_slot(episodes):
    """Chance would have 1 % of 4000 positions on each layout of {Sy} share one."""
    cells = jax.random.randint(jax.random.key(2), (4000, 1, 3, 2), 0, 12).astype(jnp.uint8)
    cells = jnp.broadcast_to(cells, (4000, BATCH, 3, 2))
    many = episodes._replace(cells=cells)
    slot, identity = (jax.jit(of)(many) for of in (observation_slots, observation_ids))
    distinct = int(identity.max()) + 1
    assert distinct > 19_900
    assert 0.98 * distinct < len(np.unique(slot)) <= distinct


def test_layouts_of_near_hashes_share_few_slots(episodes, monkeypatch):
    """The food is at 144 cells in turn."""
    near: Any = lambda layout: jnp.arange(BATCH, dtype=jnp.uint32)  # noqa: E731
    monkeypatch.setattr(counts, "layout_hashes", near)
    food = jnp.stack(jnp.divmod(jnp.arange(144), 12), axis=-1)
    cells = jnp.zeros((144, BATCH, 3, 2), jnp.uint8)
    cells = cells.at[:, :, 2].set(food[:, None].astype(jnp.uint8))
    slot = jax.jit(observation_slots)(episodes._replace(cells=cells))
    assert len(np.unique(slot)) > 0.98 * slot.size


def test_equal_observations_share_a_slot(episodes):
    slot = np.asarray(jax.jit(observation_slots)(episodes)).reshape(-1)
    boards = np.asarray(jax.jit(Episodes.observations)(episodes)).reshape(slot.size, -1)
    cells = np.asarray(episodes.cells).reshape(slot.size, -1)
    content = np.concatenate([boards, cells], axis=1)
    _, first, same = np.unique(content, axis=0, return_index=True, return_inverse=True)
    assert len(first) < slot.size
    np.testing.assert_array_equal(slot, slot[first][same.reshape(-1)])
