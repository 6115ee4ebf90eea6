"""Visit counts: the bonus, the table's slots, and the tasks that they are for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.encodings import layout_content
from agents.acting.episodes import Episodes
from agents.curiosity.base import Experience
from agents.curiosity.counts import Counts, observation_slots, visit_bonus

BATCH = 40


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


def test_equal_observations_share_a_slot_and_few_others_do():
    """Chance would have 1 % of 4000 positions on each layout of {Sy} share one."""
    layout, _ = jax.vmap(tt.make("sy").reset)(jax.random.split(jax.random.key(1), BATCH))
    cells = jax.random.randint(jax.random.key(2), (4000, 1, 3, 2), 0, 12)
    cells = jnp.repeat(cells, BATCH, axis=1).astype(jnp.uint8)
    episodes = Episodes(layout, cells, *[jnp.zeros(())] * 5)
    slot = np.asarray(jax.jit(observation_slots)(episodes))
    _, layout = np.unique(layout_content(episodes.layout), axis=0, return_inverse=True)
    layout = layout.reshape(-1)
    assert layout.max() == 4
    first = [np.argmax(layout == each) for each in range(5)]
    np.testing.assert_array_equal(slot, slot[:, first][:, layout])
    distinct = 5 * len(np.unique(episodes.cells[:, 0], axis=0))
    assert 0.98 * distinct < len(np.unique(slot)) <= distinct
