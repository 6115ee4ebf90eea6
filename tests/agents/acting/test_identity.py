"""Ids of layouts and observations, and visits within an episode."""

import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt
from agents.acting.episodes import Episodes, cells_of
from agents.acting.identity import first_visits, layout_ids, observation_ids, visits
from trap_tube_jax.positions import position_id


def test_observations_of_one_id_look_the_same():
    """Different ids may look the same, such as the agent on the food."""
    batch, steps = 12, 7
    env = tt.make("psy", max_steps=steps)

    @jax.jit
    def play():
        initial, _ = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), batch))

        def step(state, key):
            action = jax.random.randint(key, (batch, 2), 0, 4)
            return jax.vmap(env.step)(state, action)[0], cells_of(state)

        _, cells = jax.lax.scan(step, initial, jax.random.split(jax.random.key(1), steps + 1))
        return Episodes(initial, cells, *[jnp.zeros((steps, batch))] * 4)

    episodes = play()
    ids = np.asarray(jax.jit(observation_ids)(episodes)).reshape(-1)
    boards = np.asarray(jax.jit(Episodes.observations)(episodes)).reshape(len(ids), -1)
    _, look = np.unique(boards, axis=0, return_inverse=True)
    assert ids.max() + 1 < len(ids)
    for identity in set(ids.tolist()):
        assert len(set(look[ids == identity].tolist())) == 1


def test_visits():
    ids = jnp.array([[0, 5], [1, 5], [0, 5], [2, 6]])
    np.testing.assert_array_equal(visits(ids), [[1, 1], [1, 2], [2, 3], [1, 1]])
    np.testing.assert_array_equal(first_visits(ids), [[1, 1], [1, 0], [0, 0], [1, 1]])


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


def test_layouts_of_one_hash_have_different_ids(monkeypatch):
    class Zeros:
        def integers(self, low: int, high: int, size: int, dtype: type) -> np.ndarray:
            del low, high
            return np.zeros(size, dtype)

    monkeypatch.setattr(np.random, "default_rng", lambda seed: Zeros())
    states, _ = jax.jit(jax.vmap(tt.make("st").reset))(jax.random.split(jax.random.key(1), 6))
    assert len(set(np.asarray(layout_ids(states)).tolist())) == 6


def test_positions_have_different_ids():
    state = tt.base_state()
    cells = np.random.default_rng(0).integers(0, 12, (500, 3, 2)).astype(np.int32)
    ids = jax.vmap(lambda c: position_id(state.replace(agent=c[0], tool=c[1], food=c[2])))(cells)
    assert len(set(np.asarray(ids).tolist())) == len(np.unique(cells, axis=0))
