"""Repeated actions: counted within an episode, and avoided in greedy play."""

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents.acting.repeats import MEMORY, Repeats, board_ids
from agents.networks.actions import ActionDistribution
from tiny_policy import STEPS, food_next_to_agent, random_policy


def test_an_action_counts_where_it_was_taken():
    repeats = Repeats.empty(2)
    assert not repeats.counts(jnp.array([-1, 0])).any(), "nothing was taken before the first step"
    for seen, action in (([5, 5], (1, 2)), ([5, 6], (1, 2)), ([7, 5], (0, 3)), ([5, 5], (0, 3))):
        repeats = repeats.add(jnp.array(seen), jnp.array([action, action]))
    expected = np.zeros((2, 4, 4))
    expected[:, [1, 0], [2, 3]] = [(2, 1), (1, 2)]
    np.testing.assert_array_equal(repeats.counts(jnp.array([5, 5])), expected)


def test_actions_of_long_ago_are_forgotten():
    repeats = Repeats.empty(1)
    for seen in range(MEMORY + 1):
        repeats = repeats.add(jnp.array([seen]), jnp.array([[0, 0]]))
    counts = [int(repeats.counts(jnp.array([seen])).sum()) for seen in (0, 1, MEMORY)]
    assert counts == [0, 1, 1]


def test_a_penalty_changes_the_most_probable_action():
    logits = jnp.array([[0.0, 4.0, 3.0, 0.0]])
    actions = ActionDistribution(logits, logits[:, ::-1])  # grasp 1, move 2; then move 1
    penalty = jnp.zeros((1, 4, 4))
    assert actions.mode(penalty).tolist() == actions.mode().tolist() == [[1, 2]]
    penalty = penalty.at[0, 1, 2].set(0.9)
    assert actions.mode(penalty).tolist() == [[1, 2]]
    penalty = penalty.at[0, 1, 2].set(1.1)
    assert actions.mode(penalty).tolist() == [[1, 1]], "the lower index of two equal ones"


def test_boards_have_numbers_of_their_own():
    boards = jax.vmap(tt.observe)(food_next_to_agent())
    numbers = board_ids(boards)
    assert len(set(numbers.tolist())) == len(boards)
    np.testing.assert_array_equal(board_ids(boards[::-1])[::-1], numbers)


def test_under_a_high_penalty_no_action_is_repeated():
    env = tt.Environment(base=tt.base_state(1), max_steps=STEPS)
    step = jax.jit(jax.vmap(env.step))

    def repeated(penalty):
        policy, state, seen = random_policy(repeat_penalty=penalty), food_next_to_agent(), []
        carry, act = policy.initial(4), jax.jit(policy.act)
        for _ in range(STEPS):
            observation = jax.vmap(tt.observe)(state)
            action, carry = act(observation, carry)
            state, _ = step(state, action)
            pictures, pairs = map(bytes, np.asarray(observation)), map(tuple, action.tolist())
            seen.append(list(zip(pictures, pairs, strict=True)))
        ends = np.asarray(state.time)
        return [end - len(set(each[:end])) for end, *each in zip(ends, *seen, strict=True)]

    assert sum(repeated(0.0)) > 0
    assert sum(repeated(1e6)) == 0
