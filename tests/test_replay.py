"""The memory of solved episodes, and the loss that imitates them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config
from agents.acting.rollout import Trajectory, place
from agents.networks.agent import Agent
from agents.ppo import learner as ppo
from agents.ppo.replay import Replay

STEPS, CAPACITY = 4, 3
CONFIG = Config(
    max_steps=STEPS, filters=(2, 3), hidden=4, embedding=2, chunk=4, curiosity="none",
    discount=0.5, imitation_coef=2.0, imitation_episodes=CAPACITY,
)  # fmt: skip


def played(marks: list[int], solved: list[bool]) -> Trajectory:
    """Episodes whose first action's grasp is their mark; the solved ones end at step 2."""
    batch = len(marks)
    action = jnp.zeros((STEPS, batch, 2), jnp.int32).at[0, :, 0].set(jnp.array(marks))
    won = jnp.array(solved)
    base = tt.base_state()
    return Trajectory(
        layout=jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), base),
        cells=jnp.zeros((STEPS + 1, batch, 3, 2), jnp.uint8).at[..., 1].set(5),
        action=action,
        reward=jnp.zeros((STEPS, batch)).at[1].set(won * 1.0),
        mask=jnp.ones((STEPS, batch)).at[2:].set(1.0 - won),
        features=jnp.zeros((STEPS + 1, batch, 3)),
        log_prob=jnp.zeros((STEPS, batch)),
        value=jnp.zeros((STEPS, batch)),
        embedding=jnp.zeros((STEPS, batch, 4)),
    )


def remembered(replay: Replay) -> list[int]:
    return [
        int(replay.action[0, place, 0])
        for place in range(CAPACITY)
        if bool(jnp.any(replay.mask[:, place] > 0))
    ]


@pytest.fixture
def empty() -> Replay:
    return Replay.empty(tt.base_state(), CAPACITY, STEPS)


def test_solved_episodes_come_first_and_the_oldest_fall_out(empty):
    assert remembered(empty) == []
    replay = empty.remember(played([0, 1, 2], [False, False, False]))
    assert remembered(replay) == []
    replay = replay.remember(played([0, 1, 2], [False, True, False]))
    assert remembered(replay) == [1]
    replay = replay.remember(played([2, 3, 0], [True, False, False]))
    assert remembered(replay) == [2, 1]
    replay = replay.remember(played([0, 3, 3, 0], [True, True, False, False]))
    assert remembered(replay) == [0, 3, 2]


def test_more_successes_than_places(empty):
    replay = empty.remember(played([0, 1, 2, 3], [True] * 4))
    assert len(remembered(replay)) == CAPACITY


def test_imitation_loss_is_the_weighted_log_likelihood(empty):
    agent = Agent(CONFIG)
    params = agent.init(jax.random.key(0))
    replay = empty.remember(played([3, 1], [True, False]))
    loss = jax.jit(lambda params: ppo.imitation_loss(params, agent, CONFIG, replay))(params)

    boards = jax.vmap(lambda cells: tt.observe(place(tt.base_state(), cells)))(replay.cells[:, 0])

    @jax.jit
    def log_probs(params):
        features = agent.encode(params, boards)[:, None]
        embedding = agent.unroll(params, features, replay.action[:, :1], replay.reward[:, :1])
        return ppo.action_log_prob(agent.act(params, embedding), replay.action[:, :1])[:, 0]

    log_prob = log_probs(params)
    expected = -2.0 * (0.5 * log_prob[0] + 1.0 * log_prob[1]) / 2
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


def test_nothing_remembered_nothing_imitated(empty):
    agent = Agent(CONFIG)
    params = agent.init(jax.random.key(0))
    imitate = jax.jit(lambda params: ppo.imitation_loss(params, agent, CONFIG, empty))
    loss, gradient = imitate(params), jax.jit(jax.grad(imitate))(params)
    assert loss == 0
    assert all(bool(jnp.all(leaf == 0)) for leaf in jax.tree.leaves(gradient))


def test_visits_are_counted_and_pay_by_their_root():
    slot = jnp.array([[3, 3], [5, 3]])
    mask = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    bonus, visits = ppo.visit_bonus(jnp.zeros(8).at[5].set(3.0), slot, mask)
    np.testing.assert_allclose(bonus, [[2**-0.5, 2**-0.5], [0.5, 0.0]], rtol=1e-6)
    np.testing.assert_array_equal(visits, [0, 0, 0, 2, 0, 4, 0, 0])
