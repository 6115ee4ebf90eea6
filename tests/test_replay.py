"""The memory of solved episodes, and the loss that imitates them."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, make_train
from agents.acting.episodes import Episodes, place
from agents.acting.identity import observation_ids
from agents.parallel.sharding import ALONE
from agents.ppo import replay
from agents.ppo.learner import Batch

STEPS, CAPACITY = 4, 3
CONFIG = Config(
    max_steps=STEPS, filters=(2, 3), hidden=4, embedding=2, chunk=4,
    curiosity="none", discount=0.5, imitation_coef=2.0, imitation_episodes=CAPACITY,
)  # fmt: skip


remember = jax.jit(replay.remember)


def played(marks: list[int], solved: list[bool]) -> Episodes:
    """Episodes whose first action's grasp is their mark; the solved ones end at step 2."""
    batch = len(marks)
    action = jnp.zeros((STEPS, batch, 2), jnp.int32).at[0, :, 0].set(jnp.array(marks))
    won = jnp.array(solved)
    base = tt.base_state()
    return Episodes(
        layout=jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), base),
        cells=jnp.zeros((STEPS + 1, batch, 3, 2), jnp.uint8).at[..., 1].set(5),
        action=action,
        reward=jnp.zeros((STEPS, batch)).at[1].set(won * 1.0),
        discount=jnp.ones((STEPS, batch)).at[1:].set(1.0 - won),
        mask=jnp.ones((STEPS, batch)).at[2:].set(1.0 - won),
    )


def remembered(memory: Episodes) -> list[int]:
    return [
        int(memory.action[0, place, 0])
        for place in range(CAPACITY)
        if bool(jnp.any(memory.mask[:, place] > 0))
    ]


@pytest.fixture
def empty() -> Episodes:
    return replay.empty(tt.base_state(), CAPACITY, STEPS)


def test_solved_episodes_come_first_and_the_oldest_fall_out(empty):
    assert remembered(empty) == []
    memory = remember(empty, played([0, 1, 2], [False, False, False]))
    assert remembered(memory) == []
    memory = remember(memory, played([0, 1, 2], [False, True, False]))
    assert remembered(memory) == [1]
    memory = remember(memory, played([2, 3, 0], [True, False, False]))
    assert remembered(memory) == [2, 1]
    memory = remember(memory, played([0, 3, 3, 0], [True, True, False, False]))
    assert remembered(memory) == [0, 3, 2]


def test_more_successes_than_places(empty):
    memory = remember(empty, played([0, 1, 2, 3], [True] * 4))
    assert len(remembered(memory)) == CAPACITY


@pytest.fixture(scope="module")
def learner() -> Any:
    """A learner, parameters, and the imitation's loss and gradient beside a minibatch."""
    train = make_train(CONFIG)
    params = jax.jit(train.init_params)(jax.random.key(0))
    others = played([0, 2], [False, True])
    nothing = jnp.zeros((STEPS, 2))
    batch = Batch(others, observation_ids(others), nothing, nothing, nothing[..., None])

    def loss(params, memory):
        imitated = replay.Imitated.of(memory, CONFIG.discount, ALONE)
        return train.loss(params, batch, imitated)[1]["imitation_loss"]

    return train, params, jax.jit(jax.value_and_grad(loss))


def test_imitation_loss_is_the_weighted_log_likelihood(empty, learner):
    train, params, imitate = learner
    memory = remember(empty, played([3, 1], [True, False]))
    loss, gradient = imitate(params, memory)

    boards = jax.vmap(lambda cells: tt.observe(place(tt.base_state(), cells)))(memory.cells[:, 0])

    @jax.jit
    @jax.value_and_grad
    def expected(params):
        agent = train.agent
        features = agent.encode(params, boards)[:, None]
        embedding = agent.unroll(params, features, memory.action[:, :1], memory.reward[:, :1])
        log_prob = agent.act(params, embedding).actions.log_prob(memory.action[:, :1])[:, 0]
        return -2.0 * (0.5 * log_prob[0] + 1.0 * log_prob[1]) / 2

    plain_loss, plain_gradient = expected(params)
    np.testing.assert_allclose(loss, plain_loss, rtol=1e-5)
    chex.assert_trees_all_close(gradient, plain_gradient, rtol=1e-4, atol=1e-6)


def test_nothing_remembered_nothing_imitated(empty, learner):
    _, params, imitate = learner
    loss, gradient = imitate(params, empty)
    assert loss == 0
    assert all(bool(jnp.all(leaf == 0)) for leaf in jax.tree.leaves(gradient))
