"""Learning from advice: the dataset, the share of advice, the loss, and that it learns."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, make_train
from agents.dagger.explore import UNKNOWN
from agents.dagger.learner import (
    Dataset,
    Lesson,
    advised_share,
    chart,
    go_on,
    joint_log_probs,
    loss,
    play,
)
from agents.networks.agent import Agent
from agents.networks.core import Outputs
from agents.networks.distinct import position_id

CONFIG = Config(
    env_id="sy", method="dagger", max_steps=20, episodes=32, minibatch=8, epochs=1, tasks=4,
    walkers=256, walk_rounds=4, walk_steps=20, dataset=64, filters=(4, 6), hidden=4, embedding=2,
    curiosity="none", encoder="objects", chunk=4, eval_episodes=4, advice=1.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def played() -> tuple[Lesson, dict]:
    train = make_train(CONFIG)
    env, agent = train.env, train.agent
    params = agent.init(jax.random.key(0))

    def run(key):
        return play(agent, CONFIG, env, params, *chart(env, [env], key, CONFIG), key)

    lesson, metrics = jax.jit(run)(jax.random.key(2))
    return lesson._replace(right=np.asarray(lesson.right), known=np.asarray(lesson.known)), metrics


def test_the_share_of_advice_rises_over_the_episodes_of_a_task():
    share = np.asarray(advised_share(Config.preset("best", tasks=32)))
    assert share.shape == (32,)
    assert share[:8].tolist() == [0.0] * 8
    assert (np.diff(share[7:]) > 0).all()
    assert share[-1] == pytest.approx(0.9)
    never = advised_share(Config.preset("best", advised=0.0))
    assert (np.asarray(never) == 0).all()


def test_episodes_of_a_task_are_neighbours_and_the_last_ones_start_elsewhere(played):
    trajectory = played[0].trajectory
    cells = np.asarray(trajectory.cells[0]).reshape(4, 8, -1)
    assert (cells[:, :6] == cells[:, :1]).all()
    assert (cells[:, 6:] != cells[:, :1]).any(axis=-1).mean() > 0.5
    board = np.asarray(trajectory.layout.board).reshape(4, 8, -1)
    assert (board == board[:, :1]).all()


def test_advice_that_is_always_followed_solves_the_task(played):
    """The last episode of every task follows advice on all steps, and each step brings it on."""
    (trajectory, right, known), metrics = played
    number = np.asarray(tt.action_to_index(trajectory.action))
    followed = (right >> number) & 1
    last = np.arange(7, 32, 8)
    labelled = right[:, last] != 0
    assert labelled.any(axis=0).sum() >= 3
    # The walks that follow may find something better still, which is rare.
    assert (followed[:, last][labelled] == 1).mean() > 0.9
    assert np.asarray(trajectory.solved)[last].sum() >= 3
    alone = np.arange(32) % 8 < 2
    assert (followed[:, alone][right[:, alone] != 0] == 0).any()
    assert metrics["success"] == np.asarray(trajectory.solved)[alone].mean()
    over = np.asarray(trajectory.mask) == 0
    assert (right[over] == 0).all()
    assert (known[over] == 0).all()
    assert (right & ~known == 0).all()
    assert (right != known).any()


def test_what_the_agent_has_done_is_known_too():
    """The shortest plan, played with no walk that ever leaves the start."""
    task, plan = tt.base_state(), tt.solve(tt.base_state())
    states = [task]
    for action in plan.actions:
        states.append(tt.Environment().step(states[-1], jnp.asarray(action))[0])
    episode = jnp.stack([position_id(state) for state in states])
    walks = jnp.broadcast_to(episode[0], (5, 3))
    config = Config.from_dict({**CONFIG.to_dict(), "agent_rounds": 0})
    env, length = tt.Environment(), jnp.array([plan.length])
    atlas = go_on(env, task, walks, episode[None], length, jax.random.key(0), config)
    assert np.asarray(atlas.steps)[episode].tolist() == list(range(plan.length, -1, -1))
    assert (np.asarray(atlas.steps) != UNKNOWN).sum() == plan.length + 1


def test_the_dataset_replaces_its_oldest_episodes(played):
    lesson = played[0]
    trajectory, right, known = lesson
    empty = Dataset.empty(CONFIG, tt.base_state())
    assert empty.number == 0
    once = empty.add(lesson)
    assert once.number == 32
    np.testing.assert_array_equal(once.right[:, :32], right)
    np.testing.assert_array_equal(once.known[:, :32], known)
    assert not once.right[:, 32:].any()
    twice = once.add(lesson._replace(right=right + 1))
    assert twice.number == 64
    thrice = twice.add(lesson._replace(right=right + 2))
    assert thrice.number == 64
    np.testing.assert_array_equal(thrice.right, np.concatenate([right + 2, right + 1], axis=1))
    some = once.take(jnp.array([3, 1]))
    np.testing.assert_array_equal(some.cells, np.asarray(trajectory.cells)[:, [3, 1]])
    np.testing.assert_array_equal(some.action, np.asarray(trajectory.action)[:, [3, 1]])
    np.testing.assert_array_equal(some.layout.palette, trajectory.layout.palette[jnp.array([3, 1])])


def test_all_sixteen_actions_have_their_probability():
    rng = np.random.default_rng(0)
    logits = rng.normal(size=(2, 5, 4)).astype(np.float32)
    found = np.exp(joint_log_probs(Outputs(*jnp.asarray(logits), value=jnp.zeros(5))))
    grasp, move = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
    for number in range(16):
        pair = tt.action_from_index(jnp.asarray(number))
        np.testing.assert_allclose(
            found[:, number], grasp[:, pair[0]] * move[:, pair[1]], rtol=1e-5
        )


def test_the_loss_is_what_it_says(played):
    """Against a plain loop over steps, from the outputs of episodes encoded without sharing."""
    lesson = played[0]
    trajectory, right, known = lesson
    agent = Agent(CONFIG)
    params = agent.init(jax.random.key(3))
    batch = Dataset.empty(CONFIG, tt.base_state()).add(lesson).take(jnp.arange(32))
    steps = jnp.sum(batch.right != 0)
    found, metrics = loss(params, agent, CONFIG, batch, steps)
    boards = trajectory.observations()
    features = agent.encode(params, boards.reshape(-1, 12, 12, 3)).reshape(*boards.shape[:2], -1)
    hidden = agent.unroll(params, features, trajectory.action, jnp.zeros(right.shape))
    log_probs = np.float64(joint_log_probs(agent.act(params, hidden))).reshape(-1, 16)

    def total(row, bits):
        return np.logaddexp.reduce([p for number, p in enumerate(row) if (bits >> number) & 1])

    flat = (bits.reshape(-1).astype(int) for bits in (right, known))
    terms = [
        total(row, right_bits) - total(row, known_bits)
        for row, right_bits, known_bits in zip(log_probs, *flat, strict=True)
        if right_bits
    ]
    assert found == pytest.approx(-np.mean(terms), rel=1e-5)
    assert metrics["right"] == pytest.approx(np.mean(np.exp(terms)), rel=1e-5)


@pytest.mark.slow
def test_it_learns_what_is_right():
    config = Config.from_dict({**CONFIG.to_dict(), "hidden": 16, "filters": (16, 16), "epochs": 8,
                               "learning_rate": 3e-3})  # fmt: skip
    train = make_train(config)
    state = before = jax.jit(train.init)(jax.random.key(0))
    iterate = jax.jit(train.iterate)
    for _ in range(15):
        state, _ = iterate(state)
    batch = state.dataset.take(jnp.arange(64))
    steps = jnp.sum(batch.right != 0)
    losses = [
        float(loss(params, train.agent, config, batch, steps)[0])
        for params in (before.params, state.params)
    ]
    assert losses[1] < 0.8 * losses[0]
    assert state.episodes == 15 * 32


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"tasks": 5}, ["tasks", "divide", "32", "5"]),
        ({"task_sets": ("p", "sy", "psy")}, ["tasks", "multiple", "psy", "4"]),
        ({"walk_steps": 21}, ["walk_steps", "at most", "20", "21"]),
        ({"dataset": 33}, ["dataset", "multiple", "32", "33"]),
        ({"curiosity": "icm"}, ["curiosity", "none", "dagger", "icm"]),
        ({"method": "dager"}, ["method", "ppo, dagger", "dager"]),
        ({"task_sets": (1,)}, ["task_sets", "names of task sets", "1"]),
        ({"task_sets": ("q",)}, ["'q'", "base"]),
    ],
)
def test_impossible_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=".*".join(map(re.escape, words))):
        make_train(Config.from_dict({**CONFIG.to_dict(), **settings}))
