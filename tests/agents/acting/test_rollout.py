"""Episodes of the scan against a plain loop that encodes every observation."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.acting import encodings
from agents.acting.rollout import rollout
from agents.networks import chunks
from agents.networks.actions import ActionDistribution
from agents.networks.agent import Agent
from small_runs import small_config

CONFIG = small_config(env_id="psy", episodes_per_iteration=12, encode_chunk_size=4)

counts: list[int] = []  # distinct observations that `play` encoded, step by step
drawn_with: list[bytes] = []  # the keys that actions were drawn with, step by step


@pytest.fixture(scope="module")
def make_play():
    """Compiles the scan anew; it fills `counts` and `drawn_with`, and solves the first episode."""
    env = tt.make(CONFIG.env_id, max_steps=CONFIG.max_steps)
    agent = Agent(CONFIG)
    map_rows, sample = chunks.map_rows, ActionDistribution.sample

    def counting(fn, chunk, params, rows, count):
        if not isinstance(rows, tuple):  # as windows are
            jax.debug.callback(lambda count: counts.append(int(count)), count)
        return map_rows(fn, chunk, params, rows, count)

    def recording(actions, key):
        data = jax.random.key_data(key)
        jax.debug.callback(lambda data: drawn_with.append(data.tobytes()), data)
        return sample(actions, key).at[0].set(jnp.array([0, 3], jnp.int32))

    def play(params, initial):
        key = jax.random.key(2)
        return rollout(agent, params, env, initial, key)

    def make(params, initial):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(chunks, "map_rows", counting)
            patch.setattr(ActionDistribution, "sample", recording)
            # A partial of its own, because JAX remembers what it traced by function.
            return jax.jit(functools.partial(play)).lower(params, initial).compile()

    return make


@pytest.fixture(scope="module")
def played(make_play):
    env = tt.make(CONFIG.env_id, max_steps=CONFIG.max_steps)
    agent = Agent(CONFIG)
    params = jax.jit(agent.init)(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), CONFIG.episodes_per_iteration)
    initial, _ = jax.jit(jax.vmap(env.reset))(keys)
    # One episode is solved by its first move, so that an early end is among them.
    initial = initial.replace(
        agent=initial.agent.at[0].set(jnp.array([11, 4], jnp.int32)),
        food=initial.food.at[0].set(jnp.array([11, 5], jnp.int32)),
        tool=initial.tool.at[0].set(jnp.array([0, 0], jnp.int32)),
    )
    play = make_play(params, initial)
    return env, agent, params, initial, play, play(params, initial)


@jax.jit
def expected(params, episodes):
    """Values and log-probabilities, all observations being encoded by themselves and in order."""
    agent, again = Agent(CONFIG), lambda x: jnp.concatenate([x, x[-1:]])
    features = jax.vmap(functools.partial(agent.encode, params))(episodes.observations())
    action, reward = again(episodes.action), again(episodes.reward)
    embedding, _ = agent.unroll(params, again(features), action, reward)
    actions, value = agent.policy_and_value(params, embedding)
    return value, actions.log_prob(action)[:-1]


def check_outputs(params, trajectory):
    """Values are of all observations, the last one included."""
    value, log_prob = expected(params, trajectory.episodes)
    np.testing.assert_allclose(trajectory.value, value, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(trajectory.log_prob, log_prob, rtol=1e-4, atol=1e-4)


def test_episodes_follow_the_environment(played):
    env, _, _, initial, _, trajectory = played
    episodes = trajectory.episodes
    step = jax.jit(jax.vmap(env.step))
    state, done = initial, np.zeros(CONFIG.episodes_per_iteration, bool)
    for t in range(env.max_steps):
        np.testing.assert_array_equal(episodes.mask[t], ~done)
        for name, index in (("agent", 0), ("tool", 1), ("food", 2)):
            np.testing.assert_array_equal(episodes.cells[t, :, index], getattr(state, name))
        state, timestep = step(state, episodes.action[t])
        np.testing.assert_array_equal(episodes.reward[t], timestep.reward)
        np.testing.assert_array_equal(episodes.discount[t], timestep.discount)
        done = np.asarray(timestep.done)
    assert bool(episodes.solved[0])
    assert episodes.length[0] == 1
    assert not episodes.discount[:, 0].any()
    np.testing.assert_array_equal(episodes.length[1:] == CONFIG.max_steps, ~episodes.solved[1:])


def test_every_step_draws_its_actions_with_a_key_of_its_own(played):
    env, _, params, initial, play, _ = played
    jax.effects_barrier()
    drawn_with.clear()
    play(params, initial)
    jax.effects_barrier()
    assert len(set(drawn_with)) == len(drawn_with) == env.max_steps + 1


def check_ids(episodes):
    """Ids are equal where layout and cells are equal, and only there; returns their number."""
    layout = np.asarray(encodings.layout_content(episodes.layout))
    cells = np.asarray(episodes.cells).reshape(*episodes.cells.shape[:2], -1)
    content = np.concatenate([np.stack([layout] * len(cells)), cells], axis=-1)
    _, expected = np.unique(content.reshape(-1, content.shape[-1]), axis=0, return_inverse=True)
    ids = np.asarray(episodes.observation_id).reshape(-1)
    pairs = set(zip(ids.tolist(), expected.reshape(-1).tolist(), strict=True))
    assert len(pairs) == ids.max() + 1 == expected.max() + 1
    return len(pairs)


@pytest.mark.parametrize("bits", [0, 20])
def test_every_observation_is_encoded_once(played, make_play, bits, monkeypatch):
    """Across episodes and times; where hashes collide it may be more often, to the same result."""
    _, _, params, initial, play, _ = played
    if bits != encodings.CACHE_BITS:
        monkeypatch.setattr(encodings, "CACHE_BITS", bits)
        play = make_play(params, initial)
    for env_id in ("base", "psy"):
        # Several episodes of each layout, which meet again what the others have met before.
        keys = jnp.repeat(
            jax.random.split(jax.random.key(1), 3), CONFIG.episodes_per_iteration // 3
        )
        layouts, _ = jax.jit(jax.vmap(tt.make(env_id).reset))(keys)
        jax.effects_barrier()
        counts.clear()
        trajectory = play(params, layouts)
        jax.effects_barrier()
        check_outputs(params, trajectory)
        distinct = check_ids(trajectory.episodes)
        assert len(counts) == len(trajectory.episodes.cells)
        assert sum(counts) == distinct if bits else sum(counts) > distinct
