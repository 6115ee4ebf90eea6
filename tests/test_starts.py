"""Random walks, the successes that they find, and restarts inside those."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, make_train
from agents.rollout import place
from agents.starts import DETOUR, FIRST_REACH, FRESH, GRACE, Successes, Ways, explore, random_walks

CONFIG = Config(
    env_id="sy", max_steps=10, episodes=8, minibatch=4, epochs=1, filters=(2, 3), hidden=4,
    embedding=2, curiosity="none", encoder="relational", chunk=4, eval_episodes=4,
    restarts=0.5, restart_memory=16, walk_sets=("sy",), walks=(64,), walk_steps=100,
)  # fmt: skip


@pytest.fixture(scope="module")
def walks() -> Ways:
    env = tt.make("sy", max_steps=300)
    return jax.jit(lambda key: random_walks(env, key, 128))(jax.random.key(0))


@pytest.fixture
def empty() -> Successes:
    return Successes.empty(CONFIG, tt.base_state())


def ways(lengths: list[int], num_steps: int = 40) -> Ways:
    """Ways on which the agent's row is the time and its column the way's number."""
    batch = len(lengths)
    time, number = np.mgrid[: num_steps + 1, :batch]
    cells = np.zeros((num_steps + 1, batch, 3, 2), np.uint8)
    cells[..., 0, 0], cells[..., 0, 1] = time, number
    layout = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), tt.base_state())
    return Ways(layout, jnp.asarray(cells), jnp.array(lengths, jnp.int32))


def test_walks_obey_the_rules_and_end_where_the_food_is(walks):
    found = np.flatnonzero(np.asarray(walks.length))
    assert 8 <= len(found) < 128
    env = tt.Environment(max_steps=300)
    actions = tt.action_from_index(jnp.arange(16))
    successors = jax.jit(jax.vmap(jax.vmap(env.step, (None, 0)), (0, None)))
    for way in found[:4]:
        length = int(walks.length[way])
        cells = np.asarray(walks.cells[: length + 1, way])
        is_there = (cells[:, 0] == cells[:, 2]).all(axis=-1)
        assert is_there[length]
        assert not is_there[:length].any()
        layout = jax.tree.map(lambda x, way=way: x[way], walks.layout)
        padded = np.concatenate([cells, np.repeat(cells[-1:], 300 - length, axis=0)])
        states = jax.vmap(lambda cells, layout=layout: place(layout, cells))(jnp.asarray(padded))
        after, _ = successors(states, actions)
        following = np.stack([after.agent, after.tool, after.food], axis=2)[:length]
        assert (following == cells[1:, None]).all(axis=(2, 3)).any(axis=1).all()


def test_walks_keep_their_actions_for_a_while():
    env = tt.Environment(max_steps=40)
    walks = random_walks(env, jax.random.key(1), 64)
    steps = np.diff(np.asarray(walks.cells[:, :, 0]).astype(int), axis=0)
    moved = (steps != 0).any(axis=-1)
    again = (steps[1:] == steps[:-1]).all(axis=-1)[moved[1:] & moved[:-1]]
    assert 0.5 < again.mean() < 0.95  # 1/4 for independent moves


def test_successes_are_seen_from_their_ends(empty):
    known = empty.add(ways([0, 12, 0, 40]))
    assert known.number == 2
    assert known.length[:3].tolist() == [12, 30, 0]  # of 40 steps, 3 episodes' worth are kept
    assert known.reach[:3].tolist() == [FIRST_REACH, FIRST_REACH, 0]
    agents = np.asarray(known.cells[:, :2, 0])
    assert agents[:13, 0, 0].tolist() == list(range(12, -1, -1))
    assert agents[:, 1, 0].tolist() == list(range(40, 9, -1))
    assert agents[0, :, 1].tolist() == [1, 3]


def test_new_successes_fill_empty_places_only(empty):
    known = empty.add(ways([5] * 10)).add(ways([7] * 10)).add(ways([9] * 10))
    assert known.length.tolist() == [5] * 10 + [7] * 6
    known = known._replace(length=known.length.at[3].set(0), reach=jnp.full(16, 20))
    known = known.add(ways([9] * 10))
    assert known.length.tolist() == [5] * 3 + [9] + [5] * 6 + [7] * 6
    assert known.reach[3] == 9  # half of 20, but no more than there is


def test_restarts_move_back_when_solved_and_forth_when_not(empty):
    known = empty.add(ways([20, 20, 20, 4]))._replace(reach=jnp.full(16, 4))
    origin = jnp.array([0, 0, 1, FRESH, 2, 2, 2, 3])
    solved = jnp.array([True, True, False, True, False, False, False, True])
    after = known.rehearsed(origin, solved)
    assert after.reach[:3].tolist() == [8, 2, 1]
    assert after.length[:4].tolist() == [20, 20, 20, 0]  # the last one is known from its start
    assert after.reach[4:].tolist() == [4] * 12


def test_the_wanted_share_of_episodes_restarts(empty):
    assert (np.asarray(empty.choose(jax.random.key(0), CONFIG)) == FRESH).all()
    known = empty.add(ways([5] * 16))
    known = known._replace(length=jnp.where(jnp.arange(16) % 3 == 1, 5, 0))
    origin = np.concatenate([known.choose(jax.random.key(i), CONFIG) for i in range(20)])
    origin = origin.reshape(20, 8)
    assert (origin[:, :4] == FRESH).all()
    assert set(origin[:, 4:].reshape(-1).tolist()) == {1, 4, 7, 10, 13}


def test_restarts_begin_inside_a_success_with_few_steps_left(empty):
    known = empty.add(ways([20, 20, 20]))._replace(reach=jnp.array([1, 2, 9] + [0] * 13))
    env = tt.make("sy")
    tasks, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 4))
    initial = known.place(jnp.array([FRESH, 0, 1, 2]), tasks, max_steps=20)
    assert initial.agent[1:].tolist() == [[19, 0], [18, 1], [11, 2]]
    assert initial.time.tolist() == [0, 20 - DETOUR - GRACE, 20 - 2 * DETOUR - GRACE, 0]
    first = jax.tree.map(lambda x: x[0], (initial, tasks))
    jax.tree.map(np.testing.assert_array_equal, *first)


def test_walks_stop_when_the_memory_is_nearly_full(empty):
    env = tt.make("sy", max_steps=300)
    search = jax.jit(lambda key, known: explore(key, [(env, 64)], known))
    known, steps = search(jax.random.key(0), empty)
    assert known.number > 0
    assert steps == 64 * 300
    full = empty.add(ways([5] * 16))
    known, steps = search(jax.random.key(0), full)
    assert steps == 0
    jax.tree.map(np.testing.assert_array_equal, known, full)


@pytest.mark.slow
def test_training_rehearses_what_walks_have_found():
    train = make_train(CONFIG)
    iterate = jax.jit(train.iterate)
    state = jax.jit(train.init)(jax.random.key(0))
    state, before = iterate(state)
    state, metrics = iterate(state)
    lengths = [float(before["episode_length"]), float(metrics["episode_length"])]
    assert metrics["rehearsed"] > 0
    assert 0 < metrics["reach"] <= 30
    assert state.steps_walked == 2 * 6400
    assert state.transitions == round(8 * sum(lengths))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"walks": ()}, ["walks", "walk_sets", "sy", "()"]),
        ({"walk_sets": ("sy", "p")}, ["walks", "'p'", "64"]),
        ({"restarts": 0.0}, ["restarts", "walks", "together"]),
        ({"walks": (0,)}, ["walks", "[1,", "0"]),
        ({"walk_sets": (1,)}, ["walk_sets", "names of task sets", "1"]),
        ({"walk_sets": ("q",)}, ["'q'", "base"]),
    ],
)
def test_impossible_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=".*".join(map(re.escape, words))):
        make_train(Config.from_dict({**CONFIG.to_dict(), **settings}))
