"""The object encoder's description of a board, against one found cell by cell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.config import Config
from agents.networks import object_encoder
from agents.networks.agent import Agent
from agents.networks.object_encoder import describe_board
from trap_tube_jax.objects import AGENT, FOOD

describe = jax.jit(describe_board)
PALETTE = np.asarray(tt.base_state().palette)


@pytest.fixture(scope="module")
def tasks() -> tt.State:
    env = tt.make("psy")
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(3), 32))[0]


def described(board: np.ndarray) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Features and looks of every object, and positions of agent and food, cell by cell."""
    colors = [tuple(color) for color in board.reshape(-1, board.shape[-1])]
    anchors = [tuple(PALETTE[thing]) for thing in (AGENT, FOOD)]
    others = [color for color in dict.fromkeys(colors) if color not in anchors]
    cells = {color: np.argwhere((board == color).all(axis=-1)) for color in set(colors)}
    rows = []
    for color in others:
        features = []
        for axis in (0, 1):
            features += [index in cells[color][:, axis] for index in range(12)]
        for anchor in anchors:
            for axis in (0, 1):
                there = cells[anchor][0, axis] if anchor in cells else -1000
                features += [offset + there in cells[color][:, axis] for offset in range(-11, 12)]
            origin = cells[anchor][0] if anchor in cells else np.array([-1000, -1000])
            near = [(origin[0] + i, origin[1] + j) for i in range(-2, 3) for j in range(-2, 3)]
            features += [list(cell) in cells[color].tolist() for cell in near]
        size = len(cells[color])
        features += [size == number for number in range(5)] + [size / 20, np.log1p(size) / 3]
        rows.append(np.array(features, np.float32))
    nowhere = np.array([[-1000, -1000]])
    agent, food = (cells.get(anchor, nowhere)[0] for anchor in anchors)
    positions = [thing[axis] == n for thing in (agent, food) for axis in (0, 1) for n in range(12)]
    seen = min(agent[0], food[0]) >= 0
    positions += [seen and food[axis] - agent[axis] == n for axis in (0, 1) for n in range(-11, 12)]
    looks = [[color == tuple(row) for row in PALETTE] for color in others]
    return rows, np.array(looks), np.array(positions, np.float32)


def test_every_object_is_described_as_its_cells_say(tasks):
    """The last board has neither agent nor food."""
    blank = np.zeros((1, 12, 12, 3), np.uint8)
    boards = np.concatenate([jax.jit(jax.vmap(tt.observe))(tasks), blank])
    for board, *found in zip(boards, *map(np.asarray, describe(jnp.asarray(boards))), strict=True):
        features, looks_like, exists, positions = found
        expected, expected_looks, expected_positions = described(board)
        count = len(expected)
        assert exists.tolist() == [True] * count + [False] * (6 - count)
        np.testing.assert_allclose(features[:count], expected, rtol=1e-6)
        np.testing.assert_array_equal(looks_like[:count], expected_looks)
        np.testing.assert_array_equal(positions, expected_positions)


def test_objects_beyond_the_sixth_are_left_out():
    board = np.arange(144, dtype=np.uint8).reshape(1, 12, 12, 1)
    found = describe(jnp.asarray(board))
    assert found.exists.all()
    assert np.argmax(np.asarray(found.features[0, :, 12:24]), axis=1).tolist() == list(range(6))


@pytest.mark.parametrize("num_features", [1, 5])
def test_the_object_encoder_reads_any_number_of_features(num_features):
    config = Config(
        num_features=num_features, encoder="objects", filters=(4, 6), hidden=4, curiosity="none"
    )
    agent = Agent(config)
    params = jax.jit(agent.init)(jax.random.key(0))
    encode = jax.jit(agent.encode)
    board = tt.observe(tt.base_state(num_features))[None]
    features = encode(params, board)
    assert features.shape == (1, 12)
    assert describe(board).exists.sum() == 5  # ground, trap, exit, tubes, tool
    moved = tt.observe(tt.base_state(num_features).replace(agent=jnp.zeros(2, jnp.int32)))[None]
    assert (encode(params, moved) != features).any()


def test_absent_objects_do_not_change_features(monkeypatch):
    """The features of a board do not depend on what the rows of absent objects are filled with."""
    config = Config(
        encoder="objects", object_colors=True, filters=(4, 6), hidden=4, curiosity="none"
    )
    agent = Agent(config)
    params = jax.jit(agent.init)(jax.random.key(0))
    # No object but the ground; and one more, with neither agent nor food.
    boards = jnp.zeros((2, 12, 12, 3), jnp.uint8).at[1, 0, 0].set(200)
    plain = jax.jit(agent.encode)(params, boards)

    def filled(board):
        found = described_by(board)
        exists = found.exists[..., None]
        features = jnp.where(exists, found.features, noise(found.features))
        looks_like = jnp.where(exists, found.looks_like, noise(found.features)[..., :8] > 0)
        return found._replace(features=features, looks_like=looks_like)

    def noise(like):
        return jax.random.normal(jax.random.key(1), like.shape, like.dtype)

    described_by = object_encoder.describe_board
    monkeypatch.setattr(object_encoder, "describe_board", filled)
    found = jax.jit(lambda: agent.encode(params, boards))()
    np.testing.assert_allclose(found, plain, rtol=1e-5)
    assert (plain[0] != plain[1]).any()


@pytest.mark.parametrize("knows_colors", [False, True])
def test_colors_of_objects_matter_only_if_asked_for(knows_colors):
    config = Config(encoder="objects", object_colors=knows_colors, filters=(4, 6), hidden=4)
    agent = Agent(config)
    state = tt.base_state()
    recolored = tt.structural(jax.random.key(0), state)
    boards = jnp.stack([tt.observe(state), tt.observe(recolored)])
    features = jax.jit(agent.encode)(jax.jit(agent.init)(jax.random.key(0)), boards)
    assert bool((features[0] != features[1]).any()) == knows_colors


def test_features_are_a_maximum_and_a_share_over_objects_that_exist(monkeypatch):
    """However many rows there are: here all but one of a board of ground alone are empty."""
    agent = Agent(Config(encoder="objects", filters=(16, 8), hidden=4))
    params = jax.jit(agent.init)(jax.random.key(0))
    board = jnp.zeros((1, 12, 12, 3), jnp.uint8)
    found = agent.encode(params, board)
    rows = object_encoder.MAX_OBJECTS
    monkeypatch.setattr(object_encoder, "MAX_OBJECTS", 1)
    alone = agent.encode(params, board)
    assert (alone[:, :8] < 0).any(), "a maximum with the empty rows would be 0"
    np.testing.assert_allclose(found[:, :8], alone[:, :8], rtol=1e-5)
    np.testing.assert_allclose(rows * found[:, 8:], alone[:, 8:], rtol=1e-5)
