"""Episodes of the scan against a plain loop that encodes every observation."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents import Config, make_train
from agents.acting import encodings
from agents.acting.episodes import Episodes
from agents.acting.identity import first_visits, layout_ids, observation_ids, position_id, visits
from agents.acting.rollout import Trajectory, rollout, sample_action
from agents.networks import chunks
from agents.networks.agent import Agent
from agents.ppo import learner

CONFIG = Config(
    env_id="psy",
    max_steps=7,
    episodes_per_iteration=12,
    minibatch_size=6,
    epochs=2,
    curiosity="icm-detached",
    filters=(3, 4),
    hidden=6,
    embedding=2,
    encode_chunk_size=4,
)


counts: list[int] = []  # distinct observations that `play` encoded, step by step
drawn_with: list[bytes] = []  # the keys that actions were drawn with, step by step


def choose(key, actions):
    jax.debug.callback(lambda data: drawn_with.append(data.tobytes()), jax.random.key_data(key))
    return sample_action(key, actions).at[0].set(jnp.array([0, 3]))


@pytest.fixture(scope="module")
def make_play():
    """Compiles the scan anew, from parameters and B states to episodes; it fills `counts`."""
    env = tt.make(CONFIG.env_id, max_steps=CONFIG.max_steps)
    agent = Agent(CONFIG)
    map_rows = chunks.map_rows

    def counting(fn, chunk, params, rows, count):
        if not isinstance(rows, tuple):  # as windows are
            jax.debug.callback(lambda count: counts.append(int(count)), count)
        return map_rows(fn, chunk, params, rows, count)

    def play(params, initial):
        key = jax.random.key(2)
        return rollout(agent, params, env, initial, key, choose=choose)

    def make(params, initial):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(chunks, "map_rows", counting)
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
        agent=initial.agent.at[0].set(jnp.array([11, 4])),
        food=initial.food.at[0].set(jnp.array([11, 5])),
        tool=initial.tool.at[0].set(jnp.array([0, 0])),
    )
    play = make_play(params, initial)
    return env, agent, params, initial, play, play(params, initial)


@functools.cache
def encoding():
    """The plain encoding of all observations, u8[T + 1, B, 12, 12, N]."""
    agent = Agent(CONFIG)
    return jax.jit(
        lambda params, episodes: jax.vmap(lambda rows: agent.encode(params, rows))(
            episodes.observations()
        )
    )


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


def test_every_observation_has_its_own_features(played):
    _, _, params, _, _, trajectory = played
    plain = encoding()(params, trajectory.episodes)
    np.testing.assert_allclose(trajectory.features, plain, rtol=1e-4, atol=1e-5)


def test_every_step_draws_its_actions_with_a_key_of_its_own(played):
    env, _, params, initial, play, _ = played
    jax.effects_barrier()
    drawn_with.clear()
    play(params, initial)
    jax.effects_barrier()
    assert len(set(drawn_with)) == len(drawn_with) == env.max_steps + 1


@pytest.mark.parametrize("bits", [0, 20])
def test_every_observation_is_encoded_once(played, make_play, bits, monkeypatch):
    """Across episodes and times; where hashes collide it may be more often, to the same result."""
    _, _, params, initial, play, _ = played
    if bits != encodings.CACHE_BITS:
        monkeypatch.setattr(encodings, "CACHE_BITS", bits)
        play = make_play(params, initial)
    for env_id in ("base", "st"):
        # Several episodes of each layout, which meet again what the others have met before.
        keys = jnp.repeat(
            jax.random.split(jax.random.key(1), 3), CONFIG.episodes_per_iteration // 3
        )
        layouts, _ = jax.jit(jax.vmap(tt.make(env_id).reset))(keys)
        jax.effects_barrier()
        counts.clear()
        trajectory = play(params, layouts)
        jax.effects_barrier()
        plain = encoding()(params, trajectory.episodes)
        np.testing.assert_allclose(trajectory.features, plain, rtol=1e-4, atol=1e-5)
        distinct = int(jax.jit(observation_ids)(trajectory.episodes).max()) + 1
        assert len(counts) == len(trajectory.episodes.cells)
        assert sum(counts) == distinct if bits else sum(counts) > distinct


def test_network_saw_the_episodes_in_order(played):
    """Values are of all observations, the last one included."""
    _, agent, params, _, _, trajectory = played

    @jax.jit
    def expected(params, trajectory):
        episodes = trajectory.episodes
        shown = jnp.concatenate([trajectory.features, trajectory.features[-1:]])
        action = jnp.concatenate([episodes.action, episodes.action[-1:]])
        reward = jnp.concatenate([episodes.reward, episodes.reward[-1:]])
        embedding = agent.unroll(params, shown, action, reward)
        actions, value = agent.policy_and_value(params, embedding)
        return embedding[:-1], value, actions.log_prob(action)[:-1]

    embedding, value, log_prob = expected(params, trajectory)
    np.testing.assert_allclose(trajectory.embedding, embedding, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(trajectory.value, value, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(trajectory.log_prob, log_prob, rtol=1e-4, atol=1e-4)


def test_observation_ids_are_equal_for_equal_observations_alone(played):
    trajectory: Trajectory = played[-1]
    ids = np.asarray(jax.jit(observation_ids)(trajectory.episodes)).reshape(-1)
    boards = jax.jit(Episodes.observations)(trajectory.episodes)
    boards = np.asarray(boards).reshape(len(ids), -1)
    _, first = np.unique(boards, axis=0, return_inverse=True)
    # Different ids may show one board: the agent over the food, say. Never the reverse.
    for identity in set(ids.tolist()):
        assert len(set(first[ids == identity].tolist())) == 1


def test_visits():
    ids = jnp.array([[0, 5], [1, 5], [0, 5], [2, 6]])
    np.testing.assert_array_equal(visits(ids), [[1, 1], [1, 2], [2, 3], [1, 1]])
    np.testing.assert_array_equal(first_visits(ids), [[1, 1], [1, 0], [0, 0], [1, 1]])


class Problem(NamedTuple):
    """A loss and its value and gradient at some parameters."""

    total: Callable
    params: dict
    value: jax.Array
    gradient: dict


@functools.cache
def prepared(curiosity):
    """A learner with fresh parameters, and the batch that it makes of episodes."""
    train = make_train(Config.from_dict({**CONFIG.to_dict(), "curiosity": curiosity}))

    @jax.jit
    def prepare(trajectory):
        state = train.init(jax.random.key(4))
        # The same episodes with the features of these parameters.
        boards = trajectory.episodes.observations()
        features = jax.vmap(lambda rows: train.agent.encode(state.params, rows))(boards)
        trajectory = trajectory._replace(features=features)
        reward, _ = train.intrinsic_reward(state, trajectory)
        return state, train.make_batch(state, trajectory, reward)[0]

    return train, prepare


def problem(curiosity, trajectory) -> Problem:
    """Traced anew each time, for `encode_episodes` may be replaced in between."""
    train, prepare = prepared(curiosity)
    state, batch = prepare(trajectory)
    total = jax.jit(jax.value_and_grad(lambda p: train.loss(p, batch)[0]))
    return Problem(total, state.params, *total(state.params))


@pytest.mark.parametrize(
    "curiosity",
    [
        "icm",
        pytest.param("icm-detached", marks=pytest.mark.slow),
        pytest.param("rnd", marks=pytest.mark.slow),
        pytest.param("ride", marks=pytest.mark.slow),
        pytest.param("e3b", marks=pytest.mark.slow),
        pytest.param("none", marks=pytest.mark.slow),
    ],
)
def test_encoding_distinct_observations_changes_neither_loss_nor_gradient(played, curiosity):
    train, _ = prepared(curiosity)

    def plain_encoding(encode_rows, params, episodes, observation_id, *, chunk):
        del observation_id, chunk
        rows = episodes.observations()
        if "encoder" not in params:
            return jax.vmap(lambda rows: encode_rows(params, rows, None)[0])(rows)
        features = jax.vmap(lambda rows: train.agent.encode(params, rows))(rows)
        own = params.get("curiosity", {})
        return features, jax.vmap(lambda rows: train.curiosity.encode(own, rows))(rows)

    fast = problem(curiosity, played[-1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(learner, "encode_episodes", plain_encoding)
        plain = problem(curiosity, played[-1])
    pairs = (fast.value, fast.gradient), (plain.value, plain.gradient)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), *pairs)
    if curiosity == "icm":
        check_by_finite_differences(fast)


def check_by_finite_differences(loss: Problem) -> None:
    """The gradient of the whole loss, along itself; the paper's curiosity stops no gradient."""
    norm = float(np.sqrt(sum(np.sum(np.square(leaf)) for leaf in jax.tree.leaves(loss.gradient))))
    step = 1e-2 / norm

    def at(sign):
        moved = jax.tree.map(
            lambda p, g: np.asarray(p) + np.float32(sign * step) * np.asarray(g),
            loss.params,
            loss.gradient,
        )
        return loss.total(moved)[0]

    np.testing.assert_allclose((at(1) - at(-1)) / (2 * step), norm**2, rtol=2e-2)


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
    states, _ = jax.jit(jax.vmap(tt.make("st").reset))(jax.random.split(jax.random.key(1), 6))
    assert len(set(np.asarray(layout_ids(states)).tolist())) == 6


def test_positions_are_told_apart():
    state = tt.base_state()
    cells = np.random.default_rng(0).integers(0, 12, (500, 3, 2)).astype(np.int32)
    ids = jax.vmap(lambda c: position_id(state.replace(agent=c[0], tool=c[1], food=c[2])))(cells)
    assert len(set(np.asarray(ids).tolist())) == len(np.unique(cells, axis=0))
