"""The recurrent core of the network, with and without its memory."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents import Config
from agents.networks.agent import Agent
from agents.networks.core import Core

STEPS = 4
BATCH = 3


@pytest.mark.parametrize("recurrent", [True, False])
def test_a_step_depends_on_the_past_only_with_memory(recurrent):
    """Two histories that differ in their first observation alone."""
    config = Config(filters=(2, 2), hidden=4, embedding=2, recurrent=recurrent)
    agent = Agent(config)
    params = jax.jit(agent.init)(jax.random.key(0))
    action = jnp.zeros((BATCH, STEPS, 2), jnp.int32)
    reward = jnp.zeros((BATCH, STEPS), jnp.float32)
    features = jax.random.normal(jax.random.key(1), (BATCH, STEPS + 1, 2), jnp.float32)
    unroll = jax.jit(agent.unroll)
    one, _ = unroll(params, features, action, reward)
    other, _ = unroll(params, features.at[:, 0].add(1.0), action, reward)
    assert np.all(np.asarray(one[:, 0]) != np.asarray(other[:, 0]))
    same_later = np.array_equal(one[:, 1:], other[:, 1:])
    assert same_later == (not recurrent)


@pytest.mark.parametrize(
    ("update", "reset", "candidate", "expected"),
    [
        (99, 0, 5, 2),  # keeps the state
        (-99, -99, 0.5, np.tanh(0.5)),  # forgets it
        (-99, 99, 0.5, np.tanh(0.5 + 2 * 0.25 + 1)),
        (0, 0, 0, (2 + np.tanh((2 * 0.25 + 1) / 2)) / 2),
    ],
)
def test_gates_of_the_gru_keep_and_reset_the_state(update, reset, candidate, expected):
    """Of one unit in state 2, whose candidate has the recurrent weight 0.25 and bias 1."""
    params = {
        "input_kernel": jnp.zeros((1, 3)),
        "state_kernel": jnp.array([[0, 0, 0.25]]),
        "bias": jnp.array([[7.0, 7.0, 7.0], [0.0, 0.0, 1.0]]),  # the first is of the inputs
        "initial": jnp.full(1, 7.0),
    }
    inputs = jnp.array([update, reset, candidate], jnp.float32)
    core: Any = Core(1, 1)
    state = core.apply({"params": params}, jnp.array([2.0]), inputs, method=Core.advance)
    np.testing.assert_allclose(state, [expected], rtol=1e-6)


def test_an_action_is_embedded_by_its_grasp_and_by_its_move():
    core: Any = Core(1, 2)
    tables = jnp.arange(16.0).reshape(2, 4, 2)
    params = {
        name: {"embedding": table}
        for name, table in zip(("grasp_embedding", "move_embedding"), tables, strict=True)
    }
    params |= {"input_kernel": jnp.zeros((1, 3)), "state_kernel": jnp.zeros((1, 3))}
    params |= {"bias": jnp.zeros((2, 3)), "initial": jnp.zeros(1)}
    found = core.apply({"params": params}, jnp.array([3, 1]), method=Core.embed_action)
    np.testing.assert_array_equal(found, [6, 7, 10, 11])


def test_the_gru_has_the_same_parameters_without_recurrence():
    shapes = [
        jax.eval_shape(Agent(Config(recurrent=recurrent)).init, jax.random.key(0))
        for recurrent in (True, False)
    ]
    assert jax.tree.all(jax.tree.map(lambda a, b: a.shape == b.shape, *shapes))


def test_h_and_next_h_are_two_unrolls_of_the_gru():
    """h' starts again at the second observation, with the action and reward before it."""
    config = Config(filters=(2, 2), hidden=4, embedding=2)
    agent = Agent(config)
    params = jax.jit(agent.init)(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 3)
    features = jax.random.normal(keys[0], (BATCH, STEPS + 1, 2), jnp.float32)
    action = jax.random.randint(keys[1], (BATCH, STEPS, 2), 0, 4)
    reward = jax.random.normal(keys[2], (BATCH, STEPS), jnp.float32)
    h, h_next = jax.jit(lambda: agent.unroll(params, features, action, reward, with_next=True))()
    for found, first in ((h, 0), (h_next, 1)):
        state = agent.initial_state(params, BATCH)
        for t in range(STEPS):
            before = first + t - 1
            action_tm1 = action[:, before] if before >= 0 else jnp.zeros((BATCH, 2), jnp.int32)
            reward_tm1 = reward[:, before] if before >= 0 else jnp.zeros(BATCH)
            state = agent.step(params, state, features[:, first + t], action_tm1, reward_tm1)
            np.testing.assert_allclose(found[:, t], state, rtol=1e-5, atol=1e-6)
    for unroll in (1, 3):
        other = Agent(config, scan_unroll=unroll)
        again, nothing = jax.jit(other.unroll)(params, features, action, reward)
        assert nothing is None
        np.testing.assert_allclose(again, h, rtol=1e-5, atol=1e-6)


def test_previous_inputs_are_read_unless_left_out():
    """Without them, episodes of equal observations have equal outputs, whatever was done."""
    features = jax.random.normal(jax.random.key(1), (1, STEPS + 1, 2), jnp.float32)
    features = jnp.concatenate([features, features])
    action = jnp.stack([jnp.zeros((STEPS, 2), jnp.int32), jnp.ones((STEPS, 2), jnp.int32)])
    reward = jnp.zeros((2, STEPS), jnp.float32)
    for previous_inputs in (True, False):
        config = Config(filters=(2, 2), hidden=4, embedding=2, previous_inputs=previous_inputs)
        agent = Agent(config)
        params = jax.jit(agent.init)(jax.random.key(0))
        h, _ = jax.jit(agent.unroll)(params, features, action, reward)
        np.testing.assert_array_equal(h[0, 0], h[1, 0])
        assert np.array_equal(h[0], h[1]) == (not previous_inputs)
