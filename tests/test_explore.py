"""Random walks over tasks, the ways that they piece together, and the advice from them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.config import Config
from agents.dagger.explore import UNKNOWN, Atlas, explore, is_goal, look_ahead, shortest_ways, walk
from agents.networks import distinct
from trap_tube_jax.solver.distance import Distances, distances

CONFIG = Config.preset("best", walkers=128, walk_rounds=4, walk_steps=40)
ENV = tt.make("sy", max_steps=100)
GOAL = 5 * distinct.NUM_CELLS**2 + 7 * distinct.NUM_CELLS + 5


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    """Of the base task with the trap displaced, which is solved without pushing anything."""
    keys = jax.random.split(jax.random.key(0), 20)
    tasks, _ = jax.vmap(ENV.reset)(keys)
    task = jax.tree.map(lambda x: x[4], tasks)
    return jax.jit(lambda key: Atlas.of(task, explore(ENV, task, key, CONFIG)))(jax.random.key(1))


@pytest.fixture(scope="module")
def exact(atlas) -> Distances:
    return distances(atlas.task)


def known_states(atlas: Atlas) -> tuple[tt.State, np.ndarray]:
    """All states with a known way, and its steps."""
    steps = np.asarray(atlas.steps)
    positions = np.flatnonzero(steps != UNKNOWN)
    cells = jax.vmap(distinct.cells_at)(jnp.asarray(positions))
    agent, tool, food = (cells[:, i].astype(jnp.int32) for i in range(3))
    place = lambda agent, tool, food: atlas.task.replace(agent=agent, tool=tool, food=food)  # noqa: E731
    return jax.vmap(place)(agent, tool, food), steps[positions].astype(int)


def successors(states: tt.State) -> tt.State:
    actions = tt.action_from_index(jnp.arange(16))
    step = jax.jit(jax.vmap(jax.vmap(ENV.step, (None, 0)), (0, None)))
    return step(states, actions)[0]


def test_walks_start_where_tool_and_food_have_rarely_been():
    config = Config.preset("best", walkers=64, walk_rounds=8)
    task = tt.base_state()
    walks = jax.jit(lambda key: explore(tt.Environment(), task, key, config))(jax.random.key(2))
    moved = np.asarray(walks).reshape(51, 8, 64) % distinct.NUM_CELLS**2
    visits = np.bincount(moved[:, :-1].reshape(-1), minlength=distinct.NUM_CELLS**2)
    assert (moved[0, 0] == moved[0, 0, 0]).all()  # the first round starts where the task does
    drawn = visits[moved[:, :-1]]  # of states drawn without choosing
    assert np.median(visits[moved[0, -1]]) < np.median(drawn) / 10


def test_positions_are_inverted():
    numbers = jnp.array([0, 1, 143, 144, 20_735, 20_736, distinct.NUM_POSITIONS - 1])
    state = tt.base_state()

    def there_and_back(number):
        agent, tool, food = distinct.cells_at(number).astype(jnp.int32)
        return distinct.position_id(state.replace(agent=agent, tool=tool, food=food))

    np.testing.assert_array_equal(jax.vmap(there_and_back)(numbers), numbers)


def test_known_steps_are_those_of_real_ways(atlas, exact):
    """Nothing is nearer than it is, and every known way can be gone on, step by step."""
    states, steps = known_states(atlas)
    assert len(steps) > 1000
    true = exact.lookup(states).astype(int)
    assert (true >= 0).all()
    assert (steps >= true).all()
    after = successors(states)
    beyond = np.asarray(atlas.steps)[np.asarray(jax.vmap(jax.vmap(distinct.position_id))(after))]
    beyond = np.where(after.terminated, 0, beyond.astype(int))
    goal = steps == 0
    assert (np.asarray(states.agent) == np.asarray(states.food)).all(axis=1)[goal].all()
    assert (beyond.min(axis=1) <= steps - 1)[~goal].all()


def test_ways_from_many_walks_are_nearly_shortest(atlas, exact):
    states, steps = known_states(atlas)
    true = exact.lookup(states).astype(int)
    start = int(atlas.steps[distinct.position_id(atlas.task)])
    assert start <= 2 * exact.lookup(atlas.task)
    assert np.mean(steps[steps > 0] / true[steps > 0]) < 1.8


def test_advice_leads_to_the_goal(atlas):
    known = lambda state: atlas.steps[distinct.position_id(state)]  # noqa: E731
    follow = jax.jit(lambda state: look_ahead(ENV, state, known)[0])
    state = atlas.task
    steps = int(known(state))
    for _ in range(steps):
        right = np.flatnonzero(follow(state))
        assert len(right)
        state, _ = ENV.step(state, tt.action_from_index(jnp.asarray(right[-1])))
        if state.terminated:
            break
    assert state.terminated


def test_advice_is_all_that_is_nearest_and_nothing_where_nothing_is_known():
    task = tt.base_state()
    left = task.replace(agent=task.agent + jnp.array([0, -1]))

    def known(state):
        is_left = (state.agent == left.agent).all()
        return jnp.where(is_left, 7, UNKNOWN).astype(jnp.uint8)

    right, is_known = map(np.asarray, look_ahead(tt.Environment(), task, known))
    expected = np.zeros((4, 4), bool)
    expected[:, 2] = True  # to the left, whatever is grasped for
    np.testing.assert_array_equal(is_known.reshape(4, 4), expected)
    np.testing.assert_array_equal(right, is_known)
    unknown = lambda state: jnp.uint8(UNKNOWN)  # noqa: E731
    for flags in look_ahead(tt.Environment(), task, unknown):
        assert not flags.any()


def test_what_is_known_to_be_worse_is_known_but_not_right():
    task = tt.base_state()
    right, is_known = look_ahead(
        tt.Environment(), task, lambda state: state.agent[1].astype(jnp.uint8)
    )
    right, is_known = np.asarray(right).reshape(4, 4), np.asarray(is_known)
    assert is_known.all()
    assert right[:, 2].all()
    assert right.sum() == 4


def test_samples_are_known_states_short_of_the_goal(atlas):
    sample = jax.jit(lambda atlas: atlas.sample(jax.random.key(5), 64))(atlas)
    steps = np.asarray(atlas.steps)[np.asarray(jax.vmap(distinct.position_id)(sample))]
    assert (steps > 0).all()
    assert (steps != UNKNOWN).all()
    assert len(set(steps.tolist())) > 3
    assert (sample.time == 0).all()
    blank = Atlas(atlas.task, jnp.full_like(atlas.steps, UNKNOWN))
    alone = blank.sample(jax.random.key(5), 2)
    np.testing.assert_array_equal(alone.agent, [atlas.task.agent] * 2)


def test_sweeps_find_the_shortest_way_over_several_walks():
    # Two walks of three steps that meet in state 3; the second one ends in the goal.
    walks = jnp.array([[1, 4], [2, 5], [3, 3], [6, GOAL]])
    found = np.asarray(shortest_ways(walks)).astype(int)
    assert found[[GOAL, 3, 5, 4, 2, 1]].tolist() == [0, 1, 2, 3, 2, 3]
    assert np.flatnonzero(found != UNKNOWN).tolist() == [1, 2, 3, 4, 5, GOAL]


def test_ways_go_from_walks_of_one_length_over_to_those_of_another():
    walks, others = jnp.array([[1], [2], [3]]), jnp.array([[4, 8], [2, 8], [GOAL, 8], [GOAL, 8]])
    found = np.asarray(shortest_ways(walks, others)).astype(int)
    assert found[[GOAL, 2, 1, 4]].tolist() == [0, 1, 2, 2]
    assert (found[[3, 8]] == UNKNOWN).all()


def test_steps_stay_below_unknown():
    walk = 1000 + jnp.arange(300).at[-1].set(GOAL - 1000)
    found = np.asarray(shortest_ways(walk[:, None])).astype(int)[1000:1299]
    assert found[-254:].tolist() == list(range(254, 0, -1))
    assert (found[:-254] == UNKNOWN - 1).all()


def test_goals_are_where_agent_and_food_meet():
    state = tt.base_state()
    assert not is_goal(distinct.position_id(state))
    assert is_goal(distinct.position_id(state.replace(agent=state.food)))


def test_walks_keep_their_actions_for_a_while():
    env = tt.Environment(max_steps=40)
    start = jnp.full(64, distinct.position_id(tt.base_state()))
    positions = walk(env, tt.base_state(), start, jax.random.key(1), 40)
    assert (positions[0] == start).all()
    cells = np.asarray(jax.vmap(jax.vmap(distinct.cells_at))(positions)).astype(int)
    steps = np.diff(cells[:, :, 0], axis=0)
    moved = (steps != 0).any(axis=-1)
    again = (steps[1:] == steps[:-1]).all(axis=-1)[moved[1:] & moved[:-1]]
    assert 0.5 < again.mean() < 0.95  # 1/4 for independent moves
