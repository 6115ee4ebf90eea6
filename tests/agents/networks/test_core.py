"""The recurrent core of the network, with and without its memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents import Config
from agents.networks.agent import Agent

STEPS, BATCH = 4, 3


@pytest.mark.parametrize("recurrent", [True, False])
def test_a_step_depends_on_the_past_only_with_memory(recurrent):
    """Two histories that differ in their first observation alone."""
    config = Config(filters=(2, 2), hidden=4, embedding=2, recurrent=recurrent)
    agent = Agent(config)
    params = jax.jit(agent.init)(jax.random.key(0))
    action, reward = jnp.zeros((STEPS, BATCH, 2), jnp.int32), jnp.zeros((STEPS, BATCH), jnp.float32)
    features = jax.random.normal(jax.random.key(1), (STEPS + 1, BATCH, 2), jnp.float32)
    unroll = jax.jit(agent.unroll)
    one, _ = unroll(params, features, action, reward)
    other, _ = unroll(params, features.at[0].add(1.0), action, reward)
    assert np.all(np.asarray(one[0]) != np.asarray(other[0]))
    same_later = np.array_equal(one[1:], other[1:])
    assert same_later == (not recurrent)


def test_memory_changes_no_parameter():
    shapes = [
        jax.eval_shape(Agent(Config(recurrent=recurrent)).init, jax.random.key(0))
        for recurrent in (True, False)
    ]
    assert jax.tree.all(jax.tree.map(lambda a, b: a.shape == b.shape, *shapes))
