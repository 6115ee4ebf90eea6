"""Episodes of the scan against a plain loop that encodes every observation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config
from agents.acting.rollout import Trajectory, rollout, sample_action
from agents.networks import distinct
from agents.networks.agent import Agent
from agents.ppo import learner as ppo

CONFIG = Config(
    env_id="psy", max_steps=7, episodes=12, minibatch=6, epochs=2, curiosity="icm-detached",
    filters=(3, 4), hidden=6, embedding=2, chunk=4,
)  # fmt: skip


@pytest.fixture(scope="module")
def played():
    env = tt.make(CONFIG.env_id, max_steps=CONFIG.max_steps)
    agent = Agent(CONFIG)
    params = agent.init(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), CONFIG.episodes)
    initial, _ = jax.vmap(env.reset)(keys)
    # One episode is solved by its first move, so that an early end is among them.
    initial = initial.replace(
        agent=initial.agent.at[0].set(jnp.array([11, 4])),
        food=initial.food.at[0].set(jnp.array([11, 5])),
        tool=initial.tool.at[0].set(jnp.array([0, 0])),
    )

    def choose(key, outputs):
        return sample_action(key, outputs).at[0].set(jnp.array([0, 3]))

    run = jax.jit(
        lambda params: rollout(
            agent, params, env, initial, jax.random.key(2), choose=choose, chunk=CONFIG.chunk
        )
    )
    return env, agent, params, initial, run(params)


def test_episodes_follow_the_environment(played):
    env, _, _, initial, trajectory = played
    state, done = initial, np.zeros(CONFIG.episodes, bool)
    for t in range(CONFIG.max_steps):
        np.testing.assert_array_equal(trajectory.mask[t], ~done)
        for name, index in (("agent", 0), ("tool", 1), ("food", 2)):
            np.testing.assert_array_equal(trajectory.cells[t, :, index], getattr(state, name))
        state, timestep = jax.vmap(env.step)(state, trajectory.action[t])
        np.testing.assert_array_equal(trajectory.reward[t], timestep.reward)
        done = np.asarray(timestep.done)
    assert bool(trajectory.solved[0])
    assert trajectory.length[0] == 1
    np.testing.assert_array_equal(trajectory.length[1:] == CONFIG.max_steps, ~trajectory.solved[1:])


def test_every_observation_has_its_own_features(played):
    _, agent, params, _, trajectory = played
    observations = trajectory.observations()
    plain = jax.vmap(lambda rows: agent.encode(params, rows))(observations)
    np.testing.assert_allclose(trajectory.features, plain, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("env_id", ["base", "st"])
@pytest.mark.parametrize("bits", [0, 20])
def test_every_observation_is_encoded_once(env_id, bits, monkeypatch):
    """Across episodes and times; where hashes collide it may be more often, to the same result."""
    counts: list[int] = []
    map_rows = distinct.map_rows

    def counting(fn, chunk, params, rows, count):
        if not isinstance(rows, tuple):  # as windows are
            jax.debug.callback(lambda count: counts.append(int(count)), count)
        return map_rows(fn, chunk, params, rows, count)

    monkeypatch.setattr(distinct, "map_rows", counting)
    monkeypatch.setattr("agents.acting.rollout.SLOT_BITS", bits)
    config = Config.from_dict({**CONFIG.to_dict(), "env_id": env_id, "max_steps": 20})
    env, agent = tt.make(env_id, max_steps=config.max_steps), Agent(config)
    params = agent.init(jax.random.key(0))
    layouts, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(1), 3))
    # Two episodes of each layout, which meet again what the other has met before.
    initial = jax.tree.map(lambda x: jnp.concatenate([x, x]), layouts)
    trajectory = rollout(
        agent, params, env, initial, jax.random.key(2), choose=sample_action, chunk=config.chunk
    )
    jax.effects_barrier()
    plain = jax.vmap(lambda rows: agent.encode(params, rows))(trajectory.observations())
    np.testing.assert_allclose(trajectory.features, plain, rtol=1e-4, atol=1e-5)
    ids = ppo.observation_ids(trajectory.layout, trajectory.cells)
    if bits:
        assert sum(counts) == int(ids.max()) + 1
    else:
        assert sum(counts) > int(ids.max()) + 1


def test_network_saw_the_episodes_in_order(played):
    _, agent, params, _, trajectory = played
    embedding = agent.unroll(params, trajectory.features, trajectory.action, trajectory.reward)
    np.testing.assert_allclose(trajectory.embedding, embedding, rtol=1e-4, atol=1e-5)
    value = agent.act(params, embedding).value
    np.testing.assert_allclose(trajectory.value, value, rtol=1e-4, atol=1e-4)


def test_observation_ids_are_equal_for_equal_observations_alone(played):
    trajectory: Trajectory = played[-1]
    ids = np.asarray(ppo.observation_ids(trajectory.layout, trajectory.cells)).reshape(-1)
    boards = np.asarray(trajectory.observations()).reshape(len(ids), -1)
    _, first = np.unique(boards, axis=0, return_inverse=True)
    # Different ids may show one board: the agent over the food, say. Never the reverse.
    for identity in set(ids.tolist()):
        assert len(set(first[ids == identity].tolist())) == 1


def test_first_visits():
    ids = jnp.array([[0, 5], [1, 5], [0, 5], [2, 6]])
    np.testing.assert_array_equal(ppo.first_visits(ids), [[1, 1], [1, 0], [0, 0], [1, 1]])


@pytest.mark.parametrize("curiosity", ["icm", "icm-detached", "rnd", "none"])
def test_encoding_distinct_observations_changes_neither_loss_nor_gradient(played, curiosity):
    _, _, _, _, trajectory = played
    config = Config.from_dict({**CONFIG.to_dict(), "curiosity": curiosity})
    agent = Agent(config)
    params = agent.init(jax.random.key(3))
    state = ppo.make_train(config).init(jax.random.key(4))
    features = jax.vmap(lambda rows: agent.encode(params, rows))(trajectory.observations())
    batch, _, _ = ppo.prepare(
        agent, config, state._replace(params=params), trajectory._replace(features=features)
    )

    def plain_encoding(params, agent, config, observation_id, layout, cells):
        del config, observation_id
        boards = trajectory._replace(layout=layout, cells=cells).observations()
        return jax.vmap(lambda rows: agent.encode(params, rows))(boards)

    gradient = jax.jit(
        jax.grad(lambda params: ppo.loss(params, agent, config, batch, state.replay)[0])
    )
    fast = gradient(params)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "encode_episodes", plain_encoding)
        plain = jax.jit(jax.grad(lambda p: ppo.loss(p, agent, config, batch, state.replay)[0]))(
            params
        )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), fast, plain)


def test_gradient_of_the_whole_loss_by_finite_differences(played):
    """Along the gradient, with the paper's curiosity, whose losses stop no gradient."""
    _, _, _, _, trajectory = played
    config = Config.from_dict({**CONFIG.to_dict(), "curiosity": "icm"})
    agent = Agent(config)
    state = ppo.make_train(config).init(jax.random.key(4))
    params = state.params
    features = jax.vmap(lambda rows: agent.encode(params, rows))(trajectory.observations())
    batch, _, _ = ppo.prepare(agent, config, state, trajectory._replace(features=features))
    total = jax.jit(lambda params: ppo.loss(params, agent, config, batch, state.replay)[0])
    gradient = jax.jit(jax.grad(total))(params)
    norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
    step = 1e-2 / norm
    ahead = total(jax.tree.map(lambda p, g: p + step * g, params, gradient))
    behind = total(jax.tree.map(lambda p, g: p - step * g, params, gradient))
    np.testing.assert_allclose((ahead - behind) / (2 * step), norm**2, rtol=2e-2)
