"""Repeated actions: counted within an episode, and avoided in greedy play."""

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents.acting.repeats import Repeats
from agents.networks.actions import ActionDistribution
from helpers.tiny_policy import STEPS, food_next_to_agent, random_policy


def test_an_action_is_avoided_where_it_was_taken_until_it_is_forgotten():
    logits = jnp.log(jnp.array([[[0.5, 0.3, 0.1, 0.1], [0.97, 0.01, 0.01, 0.01]]]))
    actions = ActionDistribution(logits)
    for gap, best in ((0, [1, 0]), (63, [1, 0]), (64, [0, 0])):
        repeats = Repeats.empty(1)
        action = jnp.zeros((1, 2), jnp.int32)
        for seen in (0, *range(1, gap + 1), 0):
            board = jnp.full((1, 12, 12, 1), seen, jnp.uint8)
            action, repeats = repeats.choose(actions, 1.0, board)
        assert action[0].tolist() == best, gap


def test_the_penalty_grows_with_every_repeat():
    logits = jnp.log(jnp.array([[[0.97, 0.01, 0.01, 0.01], [0.9, 0.05, 0.03, 0.02]]]))
    repeats = Repeats.empty(1)
    taken = []
    for _ in range(4):
        board = jnp.zeros((1, 12, 12, 1), jnp.uint8)
        action, repeats = repeats.choose(ActionDistribution(logits), 1.0, board)
        taken.append(action[0].tolist())
    assert taken == [[0, 0]] * 3 + [[0, 1]]


def test_under_a_high_penalty_greedy_play_repeats_no_action():
    env = tt.Environment(base=tt.base_state(1), max_steps=STEPS)
    step = jax.jit(jax.vmap(env.step))

    def repeated(penalty):
        policy = random_policy(repeat_penalty=penalty)
        state = food_next_to_agent()
        seen = []
        carry = policy.initial(4)
        act = jax.jit(policy.act)
        for _ in range(STEPS):
            observation = jax.vmap(tt.observe)(state)
            action, carry = act(observation, carry)
            state, _ = step(state, action)
            pictures = map(bytes, np.asarray(observation))
            pairs = map(tuple, action.tolist())
            seen.append(list(zip(pictures, pairs, strict=True)))
        ends = np.asarray(state.time)
        return [end - len(set(rows[:end])) for end, *rows in zip(ends, *seen, strict=True)]

    assert sum(repeated(0.0)) > 0
    assert sum(repeated(1e6)) == 0
