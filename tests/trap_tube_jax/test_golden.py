"""Every recorded episode of the paper's reference environment, through the public API."""

import zlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helpers.spec_reference as spec
import trap_tube_jax as tt
from helpers.paths import DATA

RECORDING = DATA / "reference_traces.npz"
EPISODES = 1960
TRANSITIONS = 89_894


class Replay(NamedTuple):
    """States and timesteps of every episode; arrays start [episode, time]."""

    state: tt.State
    timestep: tt.TimeStep


@pytest.fixture(scope="module")
def recorded() -> dict[str, np.ndarray]:
    with np.load(RECORDING, allow_pickle=False) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    assert (len(found["board"]), found["length"].sum()) == (EPISODES, TRANSITIONS)
    assert list(found["object_names"]) == list(spec.OBJECT_NAMES)
    return found


@pytest.fixture(scope="module")
def starts(recorded) -> tt.State:
    states = [
        tt.State.create(
            board=recorded["board"][episode],
            palette=recorded["palette"][episode],
            agent=recorded["agent"][episode, 0],
            tool=recorded["tool"][episode, 0],
            tool_extent=recorded["extent"][episode],
            food=recorded["food"][episode, 0],
        )
        for episode in range(EPISODES)
    ]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *states)


@pytest.fixture(scope="module")
def replay(recorded, starts) -> Replay:
    env = tt.make("TrapTube-v0")

    def step(state, action):
        state, timestep = env.step(state, action)
        return state, Replay(state, timestep)

    def episode(state, actions):
        return jax.lax.scan(step, state, actions)[1]

    actions = jnp.asarray(recorded["action"], jnp.int32)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(episode))(starts, actions))


def _within_episode(recorded) -> np.ndarray:
    return np.arange(50) < recorded["length"][:, None]


def test_positions_rewards_and_flags_equal_the_recorded_ones(recorded, replay):
    within = _within_episode(recorded)
    for thing in ("agent", "tool", "food"):
        replayed = getattr(replay.state, thing)[within]
        np.testing.assert_array_equal(replayed, recorded[thing][:, 1:][within], err_msg=thing)
    timestep = replay.timestep
    reward = recorded["reward"][within]
    np.testing.assert_array_equal(timestep.reward[within], reward)
    assert reward.sum() == 271
    np.testing.assert_array_equal(timestep.done[within], recorded["done"][within])
    np.testing.assert_array_equal(timestep.terminated[within], reward == 1)
    assert not np.any(timestep.terminated & timestep.truncated)


def test_observations_equal_the_recorded_ones(recorded, starts, replay):
    first = np.asarray(jax.jit(jax.vmap(tt.observe))(starts))
    boards = np.concatenate([first[:, None], replay.timestep.observation], axis=1)
    for episode, length in enumerate(recorded["length"]):
        checksums = [zlib.crc32(board.tobytes()) for board in boards[episode, : length + 1]]
        np.testing.assert_array_equal(
            checksums, recorded["obs_crc32"][episode, : length + 1], err_msg=f"episode {episode}"
        )
    episodes = recorded["image_episode"]
    np.testing.assert_array_equal(first[episodes], recorded["image_first"])
    last = boards[episodes, recorded["length"][episodes]]
    np.testing.assert_array_equal(last, recorded["image_last"])


def test_states_do_not_change_after_the_end(recorded, replay):
    """Steps after the end of an episode change nothing and pay nothing."""
    past = ~_within_episode(recorded)
    episode, _ = np.nonzero(past)
    last = recorded["length"][episode] - 1
    for thing in ("agent", "tool", "food", "time", "terminated"):
        replayed = getattr(replay.state, thing)
        np.testing.assert_array_equal(replayed[past], replayed[episode, last], err_msg=thing)
    assert past.sum() > 8_000
    assert not replay.timestep.reward[past].any()


def test_the_numpy_reading_of_the_rules_agrees_with_the_recording(recorded):
    """The plain-NumPy reading under `tests/` is itself held to the recording."""
    episode, time = np.nonzero(_within_episode(recorded))
    before = {name: recorded[name][episode, time] for name in ("agent", "tool", "food")}
    grasp, move = recorded["action"][episode, time].T
    moved = spec.step(
        spec.Layouts(recorded["board"][episode], recorded["extent"][episode]),
        spec.Cell(*before["agent"].T),
        spec.Cell(*before["tool"].T),
        spec.Cell(*before["food"].T),
        (grasp, move),
    )
    displacement = spec.DIRECTIONS[move]
    for name in ("agent", "tool", "food"):
        after = before[name] + displacement * getattr(moved, name)[:, None]
        np.testing.assert_array_equal(after, recorded[name][episode, time + 1], err_msg=name)
    np.testing.assert_array_equal(moved.solved, recorded["reward"][episode, time] == 1)
