"""Episodes of the scan against a plain loop that encodes every observation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, make_train
from agents.acting.identity import first_visits, layout_ids, observation_ids, position_id, visits
from agents.acting.rollout import Trajectory, rollout, sample_action
from agents.networks import chunks
from agents.networks.agent import Agent
from agents.ppo import learner

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

    def choose(key, actions):
        return sample_action(key, actions).at[0].set(jnp.array([0, 3]))

    run = jax.jit(
        lambda params: rollout(
            agent, params, env, initial, jax.random.key(2), choose=choose, chunk=CONFIG.chunk
        )
    )
    return env, agent, params, initial, run(params)


def test_episodes_follow_the_environment(played):
    env, _, _, initial, trajectory = played
    episodes = trajectory.episodes
    state, done = initial, np.zeros(CONFIG.episodes, bool)
    for t in range(env.max_steps):
        np.testing.assert_array_equal(episodes.mask[t], ~done)
        for name, index in (("agent", 0), ("tool", 1), ("food", 2)):
            np.testing.assert_array_equal(episodes.cells[t, :, index], getattr(state, name))
        state, timestep = jax.vmap(env.step)(state, episodes.action[t])
        np.testing.assert_array_equal(episodes.reward[t], timestep.reward)
        np.testing.assert_array_equal(episodes.discount[t], timestep.discount)
        done = np.asarray(timestep.done)
    assert bool(episodes.solved[0])
    assert episodes.length[0] == 1
    assert not episodes.discount[:, 0].any()
    np.testing.assert_array_equal(episodes.length[1:] == CONFIG.max_steps, ~episodes.solved[1:])


def test_every_observation_has_its_own_features(played):
    _, agent, params, _, trajectory = played
    observations = trajectory.episodes.observations()
    plain = jax.vmap(lambda rows: agent.encode(params, rows))(observations)
    np.testing.assert_allclose(trajectory.features, plain, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("env_id", ["base", "st"])
@pytest.mark.parametrize("bits", [0, 20])
def test_every_observation_is_encoded_once(env_id, bits, monkeypatch):
    """Across episodes and times; where hashes collide it may be more often, to the same result."""
    counts: list[int] = []
    map_rows = chunks.map_rows

    def counting(fn, chunk, params, rows, count):
        if not isinstance(rows, tuple):  # as windows are
            jax.debug.callback(lambda count: counts.append(int(count)), count)
        return map_rows(fn, chunk, params, rows, count)

    monkeypatch.setattr(chunks, "map_rows", counting)
    monkeypatch.setattr("agents.acting.encodings.SLOT_BITS", bits)
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
    plain = jax.vmap(lambda rows: agent.encode(params, rows))(trajectory.episodes.observations())
    np.testing.assert_allclose(trajectory.features, plain, rtol=1e-4, atol=1e-5)
    ids = observation_ids(trajectory.episodes)
    if bits:
        assert sum(counts) == int(ids.max()) + 1
    else:
        assert sum(counts) > int(ids.max()) + 1


def test_network_saw_the_episodes_in_order(played):
    """Values are of all observations, the last one included."""
    _, agent, params, _, trajectory = played
    episodes = trajectory.episodes
    shown = jnp.concatenate([trajectory.features, trajectory.features[-1:]])
    action = jnp.concatenate([episodes.action, episodes.action[-1:]])
    reward = jnp.concatenate([episodes.reward, episodes.reward[-1:]])
    embedding = agent.unroll(params, shown, action, reward)
    np.testing.assert_allclose(trajectory.embedding, embedding[:-1], rtol=1e-4, atol=1e-5)
    actions, value = agent.act(params, embedding)
    np.testing.assert_allclose(trajectory.value, value, rtol=1e-4, atol=1e-4)
    log_prob = actions.log_prob(action)[:-1]
    np.testing.assert_allclose(trajectory.log_prob, log_prob, rtol=1e-4, atol=1e-4)


def test_observation_ids_are_equal_for_equal_observations_alone(played):
    trajectory: Trajectory = played[-1]
    ids = np.asarray(observation_ids(trajectory.episodes)).reshape(-1)
    boards = np.asarray(trajectory.episodes.observations()).reshape(len(ids), -1)
    _, first = np.unique(boards, axis=0, return_inverse=True)
    # Different ids may show one board: the agent over the food, say. Never the reverse.
    for identity in set(ids.tolist()):
        assert len(set(first[ids == identity].tolist())) == 1


def test_visits():
    ids = jnp.array([[0, 5], [1, 5], [0, 5], [2, 6]])
    np.testing.assert_array_equal(visits(ids), [[1, 1], [1, 2], [2, 3], [1, 1]])
    np.testing.assert_array_equal(first_visits(ids), [[1, 1], [1, 0], [0, 0], [1, 1]])


def acted(train, params, trajectory: Trajectory) -> Trajectory:
    """The same episodes with the features of these parameters."""
    boards = trajectory.episodes.observations()
    features = jax.vmap(lambda rows: train.agent.encode(params, rows))(boards)
    return trajectory._replace(features=features)


@pytest.mark.parametrize("curiosity", ["icm", "icm-detached", "rnd", "ride", "e3b", "none"])
def test_encoding_distinct_observations_changes_neither_loss_nor_gradient(played, curiosity):
    trajectory = played[-1]
    train = make_train(Config.from_dict({**CONFIG.to_dict(), "curiosity": curiosity})).learner
    state = train.init(jax.random.key(4))
    batch, _, _ = train.prepare(state, acted(train, state.params, trajectory))

    def plain_encoding(encode_rows, params, episodes, observation_id, *, chunk):
        del observation_id, chunk
        rows = episodes.observations()
        if "encoder" not in params:
            return jax.vmap(lambda rows: encode_rows(params, rows, None)[0])(rows)
        features = jax.vmap(lambda rows: train.agent.encode(params, rows))(rows)
        own = params.get("curiosity", {})
        return jnp.concatenate(
            [features, jax.vmap(lambda rows: train.curiosity.encode(own, rows))(rows)], axis=-1
        )

    def gradient():
        # Traced anew each time, for `encode_episodes` is replaced in between.
        return jax.jit(jax.grad(lambda p: train.loss(p, batch, state.replay)[0]))(state.params)

    fast = gradient()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learner, "encode_episodes", plain_encoding)
        plain = gradient()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), fast, plain)


def test_gradient_of_the_whole_loss_by_finite_differences(played):
    """Along the gradient, with the paper's curiosity, whose losses stop no gradient."""
    train = make_train(Config.from_dict({**CONFIG.to_dict(), "curiosity": "icm"})).learner
    state = train.init(jax.random.key(4))
    params = state.params
    batch, _, _ = train.prepare(state, acted(train, params, played[-1]))
    total = jax.jit(lambda params: train.loss(params, batch, state.replay)[0])
    gradient = jax.jit(jax.grad(total))(params)
    norm = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
    step = 1e-2 / norm
    ahead = total(jax.tree.map(lambda p, g: p + step * g, params, gradient))
    behind = total(jax.tree.map(lambda p, g: p - step * g, params, gradient))
    np.testing.assert_allclose((ahead - behind) / (2 * step), norm**2, rtol=2e-2)


def test_layouts_share_an_id_only_if_equal():
    env = tt.make("pstsy")
    keys = jax.random.split(jax.random.key(0), 40)
    states, _ = jax.jit(jax.vmap(env.reset))(jnp.concatenate([keys, keys[::-1]]))
    ids = np.asarray(layout_ids(states))
    parts = (states.board, states.palette, states.tool_extent)
    content = [
        tuple(np.concatenate([np.ravel(leaf[i]) for leaf in parts]).tolist()) for i in range(80)
    ]
    same = np.array([[a == b for a in content] for b in content])
    np.testing.assert_array_equal(ids[:, None] == ids[None], same)
    assert len(set(ids.tolist())) == len(set(content))


def test_equal_hashes_do_not_merge_layouts(monkeypatch):
    """With a hash that says nothing, layouts are still told apart by their content."""

    class Zeros:
        def integers(self, low: int, high: int, size: int, dtype: type) -> np.ndarray:
            del low, high
            return np.zeros(size, dtype)

    monkeypatch.setattr(np.random, "default_rng", lambda seed: Zeros())
    states, _ = jax.vmap(tt.make("st").reset)(jax.random.split(jax.random.key(1), 6))
    assert len(set(np.asarray(layout_ids(states)).tolist())) == 6


def test_positions_are_told_apart():
    state = tt.base_state()
    cells = np.random.default_rng(0).integers(0, 12, (500, 3, 2)).astype(np.int32)
    ids = jax.vmap(lambda c: position_id(state.replace(agent=c[0], tool=c[1], food=c[2])))(cells)
    assert len(set(np.asarray(ids).tolist())) == len(np.unique(cells, axis=0))
