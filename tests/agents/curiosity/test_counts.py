"""Visit counts: the bonus, the table's slots, and the tasks that they are for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.episodes import Episodes
from agents.curiosity.base import Experience
from agents.curiosity.counts import VISIT_BITS, Counts, visit_bonus
from agents.networks.grouping import slots


@pytest.mark.parametrize("env_id", ["base", "sy", "p", "st", "pstsy"])
def test_counts_are_for_tasks_that_recur(env_id):
    if env_id in ("base", "sy"):
        assert Counts(tt.make(env_id)).memory().shape == (2**20,)
    else:
        with pytest.raises(ValueError, match="'counts' needs tasks that recur: base or Sy"):
            Counts(tt.make(env_id))


def test_visits_pay_by_the_root_of_their_number():
    slot = jnp.array([[3, 3], [5, 3]])
    mask = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    bonus, visits = visit_bonus(jnp.zeros(8).at[5].set(3.0), slot, mask)
    np.testing.assert_allclose(bonus, [[2**-0.5, 2**-0.5], [0.5, 0.0]], rtol=1e-6)
    np.testing.assert_array_equal(visits, [0, 0, 0, 2, 0, 4, 0, 0])


def test_the_next_observation_pays_until_the_episode_ends():
    column = jnp.array([[0, 0], [0, 2], [1, 3], [0, 0]])  # of the agent, in two episodes
    cells = jnp.zeros((4, 2, 3, 2), jnp.uint8).at[:, :, 0, 1].set(column.astype(jnp.uint8))
    mask = jnp.array([[1.0, 1.0], [1.0, 0.0], [1.0, 0.0]])
    layout = jax.tree.map(lambda x: jnp.stack([x, x]), tt.base_state())
    counts, episodes = Counts(tt.make("base")), Episodes(layout, cells, *[mask] * 5)
    pay, visits = counts.reward({}, counts.memory(), Experience(episodes, mask))
    np.testing.assert_allclose(pay.T, [[0.5**0.5, 1, 0.5**0.5], [1, 0, 0]], rtol=1e-6)
    assert visits.sum() == 4


def test_few_observations_share_a_slot():
    """Chance would have 0.4 % of 8000 positions share one."""
    layout = jax.tree.map(lambda x: x[None], tt.base_state())
    cells = jax.random.randint(jax.random.key(2), (8000, 1, 3, 2), 0, 12).astype(jnp.uint8)
    boards = Episodes(layout, cells, *[jnp.zeros(())] * 5).observations().reshape(8000, -1)
    distinct = len(np.unique(boards, axis=0))
    assert 0.98 * distinct < len(np.unique(slots(boards, VISIT_BITS))) <= distinct
