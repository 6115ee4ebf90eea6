"""Episodes of the scan against a plain loop over their steps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting.rollout import rollout
from agents.networks.actions import ActionDistribution
from agents.networks.agent import Agent
from helpers.small_runs import small_config

CONFIG = small_config(env_id="psy", episodes_per_iteration=12)

drawn_with: list[bytes] = []  # the keys that actions were drawn with, step by step


@pytest.fixture(scope="module")
def played():
    """Plays with sampled actions, except in the first episode, which its first move solves."""
    env = tt.make(CONFIG.env_id, max_steps=CONFIG.max_steps)
    agent = Agent(CONFIG)
    params = jax.jit(agent.init)(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), CONFIG.episodes_per_iteration)
    initial, _ = jax.jit(jax.vmap(env.reset))(keys)
    initial = initial.replace(
        agent=initial.agent.at[0].set(jnp.array([11, 4], jnp.int32)),
        food=initial.food.at[0].set(jnp.array([11, 5], jnp.int32)),
        tool=initial.tool.at[0].set(jnp.array([0, 0], jnp.int32)),
    )
    sample = ActionDistribution.sample

    def recording(actions, key):
        data = jax.random.key_data(key)
        jax.debug.callback(lambda data: drawn_with.append(data.tobytes()), data)
        return sample(actions, key).at[0].set(jnp.array([0, 3], jnp.int32))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ActionDistribution, "sample", recording)
        play = jax.jit(lambda p, states: rollout(agent, p, env, states, jax.random.key(2)))
        trajectory = play(params, initial)
    jax.effects_barrier()
    return env, agent, params, initial, trajectory


def test_values_and_log_probabilities_belong_to_the_observations_in_order(played):
    """Values are of all observations, the last one included."""
    _, agent, params, _, trajectory = played
    episodes = trajectory.episodes

    @jax.jit
    def expected():
        again = lambda x: jnp.concatenate([x, x[:, -1:]], axis=1)  # noqa: E731
        features = jax.vmap(functools.partial(agent.encode, params))(episodes.observations())
        action = again(episodes.action)
        reward = again(episodes.reward)
        hidden, _ = agent.unroll(params, again(features), action, reward)
        actions, value = agent.policy_and_value(params, hidden)
        return value, actions.log_prob(action)[:, :-1]

    value, log_prob = expected()
    np.testing.assert_allclose(trajectory.value, value, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(trajectory.log_prob, log_prob, rtol=1e-4, atol=1e-4)


def test_episodes_follow_the_environment(played):
    env, _, _, initial, trajectory = played
    episodes = trajectory.episodes
    step = jax.jit(jax.vmap(env.step))
    state = initial
    done = np.zeros(CONFIG.episodes_per_iteration, bool)
    for t in range(env.max_steps):
        np.testing.assert_array_equal(episodes.mask[:, t], ~done)
        for name, index in (("agent", 0), ("tool", 1), ("food", 2)):
            np.testing.assert_array_equal(episodes.cells[:, t, index], getattr(state, name))
        state, timestep = step(state, episodes.action[:, t])
        np.testing.assert_array_equal(episodes.reward[:, t], timestep.reward)
        np.testing.assert_array_equal(episodes.discount[:, t], timestep.discount)
        done = np.asarray(timestep.done)
    assert bool(episodes.solved[0])
    assert episodes.length[0] == 1
    assert not episodes.discount[0].any()
    np.testing.assert_array_equal(episodes.length[1:] == CONFIG.max_steps, ~episodes.solved[1:])


def test_every_step_draws_its_actions_with_another_key(played):
    assert len(set(drawn_with)) == len(drawn_with) == played[0].max_steps + 1
