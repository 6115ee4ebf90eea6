"""Trained policies act from observations alone, as the evaluator plays them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.networks.agent import Agent
from agents.runs.evaluator import Evaluator
from helpers.tiny_policy import CONFIG, FOOD_CELLS, STEPS, food_next_to_agent, random_policy
from helpers.trees import COPIES, assert_same
from trap_tube_jax.scoring import Suite, evaluation_tasks


def drive(policy, tasks):
    """Plays with nothing but observations, as a user would; returns solved, length, actions."""
    env = tt.Environment(base=tt.base_state(1), max_steps=STEPS)
    step = jax.jit(jax.vmap(env.step))
    act = jax.jit(policy.act)
    batch = len(tasks.time)
    state = tasks
    carry = policy.initial(batch)
    observation = jax.vmap(tt.observe)(tasks)
    solved = np.zeros(batch, bool)
    length = np.zeros(batch, int)
    actions = []
    for time in range(STEPS):
        action, carry = act(observation, carry, jax.random.key(time))
        length += ~np.asarray(state.terminated | state.truncated)
        state, timestep = step(state, action)
        observation = timestep.observation
        solved |= np.asarray(timestep.reward) > 0
        actions.append(np.asarray(action))
    return solved, length, np.stack(actions, axis=1)


@pytest.mark.parametrize(
    ("seed", "settings"),
    [
        (3, {}),
        (4, {}),
        (4, {"align_to_food": True}),
        (3, {"encoder": "objects"}),
        (3, {"repeat_penalty": 3.0}),
    ],
)
def test_a_policy_reaches_the_evaluators_outcomes(seed, settings):
    policy = random_policy(seed, **settings)
    tasks = food_next_to_agent()
    solved, length, actions = drive(policy, tasks)
    suite = Suite({"mine": tasks}, {"mine": STEPS})
    played = Evaluator(policy.config, suite)(policy.params)["mine"]
    np.testing.assert_array_equal(solved, played.solved)
    np.testing.assert_array_equal(length, played.length)
    assert solved.any() or policy.config.align_to_food  # whose four tasks look the same
    assert length.max() > 1  # the recurrent state matters
    for index, count in enumerate(length):
        np.testing.assert_array_equal(actions[index, :count], played.action[index, :count])
    if settings.keys() & {"align_to_food", "repeat_penalty"}:
        plain = policy.replace(config=CONFIG)
        assert not np.array_equal(actions, drive(plain, tasks)[2])


def test_a_board_stays_turned_as_at_the_first_observation():
    policy = random_policy(align_to_food=True)
    boards = jax.vmap(tt.observe)(food_next_to_agent())
    _, carry = policy.act(boards, policy.initial(4))
    _, after = policy.act(boards[::-1], carry)
    assert_same(after.symmetry, carry.symmetry)


def test_stepping_scoring_and_evaluating_have_one_result(fresh_task_sets):
    def near(key, state):
        cells = jnp.array(FOOD_CELLS, jnp.int32)
        return state.replace(food=cells[jax.random.randint(key, (), 0, 4)])

    tt.register("Near-v0", (near,), base=tt.base_state(1), max_steps=STEPS)
    policy = random_policy(4)
    evaluator = Evaluator.of_sets(policy.config, ["Near-v0"], 8)
    (evaluated,) = evaluator.suite.scores(evaluator(policy.params)).sets
    solved, length, _ = drive(policy, evaluation_tasks("Near-v0", 8))
    scored = tt.score(policy, ["Near-v0"], tasks=8)["Near-v0"]
    assert 0 < scored.percent < 100
    assert scored.percent == evaluated.percent == 100 * solved.mean()
    assert scored.mean_steps == evaluated.mean_steps == length[solved].mean()


def test_a_policy_may_draw_its_actions():
    policy = random_policy().replace(greedy=False)
    observation = jax.vmap(tt.observe)(food_next_to_agent())
    draw = jax.jit(lambda key: policy.act(observation, policy.initial(4), key)[0])
    drawn = np.stack([draw(jax.random.key(seed)) for seed in range(8)])
    assert len(np.unique(drawn.reshape(8, -1), axis=0)) > 1
    np.testing.assert_array_equal(draw(jax.random.key(0)), drawn[0])
    greedy = policy.replace(greedy=True)
    for key in (None, jax.random.key(0), jax.random.key(1)):
        action, _ = greedy.act(observation, greedy.initial(4), key)
        np.testing.assert_array_equal(action, greedy.act(observation, greedy.initial(4))[0])


@pytest.mark.parametrize(
    ("batch", "convert", "key", "message"),
    [
        (3, jnp.asarray, 0, r"must be uint8\[3, 12, 12, 1\], got uint8\[4, 12, 12, 1"),
        (4, lambda x: x / 255, 0, r"got float32\[4, 12, 12, 1\]"),
        (4, jnp.asarray, None, "a policy that draws its actions needs a key"),
    ],
)
def test_unusable_arguments_are_refused(batch, convert, key, message):
    policy = random_policy().replace(greedy=False)
    observation = convert(jax.vmap(tt.observe)(food_next_to_agent()))
    with pytest.raises(ValueError, match=message):
        policy.act(observation, policy.initial(batch), None if key is None else jax.random.key(key))


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
def test_copies_are_equal(copied):
    policy = random_policy()
    agent = Agent(CONFIG)
    carry = policy.initial(2)
    assert_same(copied(policy).params, policy.params)
    assert copied(policy).replace(params=None) == policy.replace(params=None)
    assert_same(copied(carry), carry)
    assert vars(copied(agent)) == vars(agent)
