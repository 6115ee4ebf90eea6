"""Observations for agents, with any number of feature channels, and pictures for people."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helpers.spec_reference as spec
import trap_tube_jax as tt


@pytest.fixture(scope="module")
def scattered() -> list[tt.State]:
    """States with objects in any cells, also on top of one another."""
    random = np.random.default_rng(7)
    states = []
    for _ in range(200):
        length = random.integers(1, 5)
        extent = (length, 1) if random.random() < 0.5 else (1, length)
        tool = random.integers(0, 13 - np.array(extent))
        beside_tool = np.clip(tool + random.integers(-1, 2, (2, 2)), 0, 11)
        agent, food = np.where(random.random((2, 1)) < 0.5, beside_tool, random.integers(0, 12))
        fields = {
            "board": random.integers(0, 5, (12, 12)).astype(np.uint8),
            "palette": random.integers(0, 256, (8, 3)).astype(np.uint8),
            "agent": agent.astype(np.int32),
            "tool": tool.astype(np.int32),
            "tool_extent": np.array(extent, np.int32),
            "food": food.astype(np.int32),
        }
        states.append(tt.base_state().replace(**fields))
    return states


def expected_objects(state: tt.State) -> np.ndarray:
    board = np.asarray(state.board)
    return spec.visible(board, state.agent, state.tool, state.tool_extent, state.food)


def test_later_objects_hide_earlier_ones(scattered):
    visible_objects = jax.jit(tt.visible_objects)
    observe = jax.jit(tt.observe)
    hidden = 0
    for state in scattered:
        expected = expected_objects(state)
        objects = visible_objects(state)
        observation = observe(state)
        np.testing.assert_array_equal(objects, expected)
        np.testing.assert_array_equal(observation, np.asarray(state.palette)[expected])
        assert (objects.dtype, observation.dtype) == (np.uint8, np.uint8)
        hidden += spec.FOOD not in expected
    assert hidden > 20


def test_ascii_pictures_show_the_topmost_objects_and_read_back(scattered):
    for state in scattered[:20]:
        rows = tt.render_ascii(state).splitlines()
        shown = np.array([[".xe12FTA".index(char) for char in row] for row in rows])
        np.testing.assert_array_equal(shown, expected_objects(state))
    picture = tt.render_ascii(tt.base_state())
    assert picture.splitlines()[5] == ".T..xF.e...."
    assert tt.State.from_ascii(picture) == tt.base_state()


@pytest.mark.parametrize("num_features", [1, 2, 3, 4, 16])
def test_features_are_the_luma_or_repeat_red_green_and_blue(num_features):
    luma = np.round(spec.BASE_COLORS @ (0.299, 0.587, 0.114))[:, None]
    repeated = spec.BASE_COLORS[:, np.arange(num_features) % 3]
    palette = tt.base_palette(num_features)
    np.testing.assert_array_equal(palette, luma if num_features == 1 else repeated)
    assert palette.dtype == np.uint8
    assert len(np.unique(palette, axis=0)) == 7, "the tubes alone look alike"


@pytest.mark.parametrize("num_features", [1, 5])
def test_any_number_of_features_works_end_to_end(num_features):
    env = tt.make("stsy", num_features=num_features)

    @jax.jit
    def reset_and_step(key, action):
        state, first = env.reset(key)
        return state, first.observation, env.step(state, action)[1].observation

    state, first, second = reset_and_step(jax.random.key(0), jnp.array((0, 1)))
    described = env.observation_spec
    assert described.shape == (12, 12, num_features)
    assert (described.minimum, described.maximum) == (0, 255)
    for observation in (first, second):
        assert (observation.shape, observation.dtype) == (described.shape, described.dtype)
    np.testing.assert_array_equal(first, np.asarray(state.palette)[expected_objects(state)])
