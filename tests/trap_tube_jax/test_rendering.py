"""Pictures: exact colours, signs that tell objects apart, GIF files."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import trap_tube_jax as tt
from helpers.refusal import assert_refused
from trap_tube_jax import objects, rendering

CELL = 16
FRAMES = np.zeros((1, 4, 4, 3), np.uint8)


def cells(picture, size=CELL):
    """[12, 12, s, s, 3]: the picture of every cell."""
    return np.asarray(picture).reshape(12, size, 12, size, 3).swapaxes(1, 2)


@pytest.mark.parametrize(
    ("features", "channels"),
    [(1, [0, 0, 0]), (2, [0, 1, None]), (3, [0, 1, 2]), (5, [0, 1, 2])],
)
def test_one_pixel_per_cell_is_the_observation_in_rgb(features, channels):
    palette = np.arange(8 * features, dtype=np.uint8).reshape(8, features) + 50
    state = tt.base_state(features).replace(palette=palette)
    observation = np.asarray(tt.observe(state))
    zeros = np.zeros((12, 12), np.uint8)
    expected = np.stack([zeros if c is None else observation[..., c] for c in channels], -1)
    np.testing.assert_array_equal(tt.render(state, 1, grasp=0), expected)


@pytest.mark.parametrize("size", [3, 7])
def test_every_cell_keeps_its_exact_color_at_any_size(size):
    palette = np.random.default_rng(0).integers(0, 256, (8, 3))
    state = tt.base_state().replace(palette=palette.astype(np.uint8))
    picture = tt.render(state, size, grid=False)
    assert picture.shape == (12 * size, 12 * size, 3)
    assert picture.dtype == jnp.uint8
    observation = np.asarray(tt.observe(state))
    same = (cells(picture, size) == observation[:, :, None, None]).all(-1)
    assert (same.mean((2, 3)) > 0.3).all()


def test_signs_tell_objects_apart_when_all_colors_collide():
    state = tt.base_state().replace(palette=np.full((8, 3), 90, np.uint8))
    tiles = cells(tt.render(state, CELL))
    codes = np.asarray(tt.visible_objects(state))
    inner = tiles[:, :, 2:-2, 2:-2]
    tile_of = {code: inner[tuple(np.argwhere(codes == code)[0])] for code in range(8)}
    for one, other in itertools.combinations(range(8), 2):
        differs = (tile_of[one] != tile_of[other]).any(-1)
        assert differs.mean() > 0.05, (objects.OBJECT_NAMES[one], objects.OBJECT_NAMES[other])


@pytest.mark.parametrize(("color", "ink"), [(20, 255), (235, 0)])
def test_signs_stand_out_from_their_color(color, ink):
    state = tt.base_state().replace(palette=np.full((8, 3), color, np.uint8))
    trap = cells(tt.render(state, CELL, grid=False))[5, 4]
    assert abs(trap[CELL // 2, CELL // 2].astype(int) - ink).max() < 60
    assert (trap[0, 0] == color).all()


def test_the_tool_is_one_bar_and_hidden_below_the_agent():
    state = tt.base_state().replace(agent=jnp.array([5, 1], jnp.int32))
    tiles = cells(tt.render(state, CELL, grid=False))
    alone = cells(tt.render(tt.base_state(), CELL, grid=False))
    ink = alone[5, 1, :, CELL // 2]
    assert (ink == ink[0]).all()
    assert (ink[0] != objects.BASE_COLORS[objects.TOOL]).any()
    np.testing.assert_array_equal(tiles[5, 1], alone[9, 1])
    np.testing.assert_array_equal(tiles[4, 1], alone[4, 1])


def test_a_horizontal_tool_is_the_vertical_one_turned():
    def draw(tool, extent):
        tool, extent = jnp.array([tool, extent], jnp.int32)
        state = tt.base_state().replace(tool=tool, tool_extent=extent)
        return cells(tt.render(state, CELL, grid=False))

    lying = draw([2, 3], [1, 4])[2, 3:7]
    standing = draw([3, 2], [4, 1])[3:7, 2]
    np.testing.assert_array_equal(lying, standing.swapaxes(1, 2))
    assert (lying != objects.BASE_COLORS[objects.TOOL]).any()


def test_grid_lines_surround_the_cells():
    state = tt.base_state()
    changed = np.asarray(tt.render(state, 8) != tt.render(state, 8, grid=False)).any(-1)
    rows = np.flatnonzero(changed.all(axis=-1))
    np.testing.assert_array_equal(rows, [*range(0, 96, 8), 95])
    np.testing.assert_array_equal(changed, changed.T)


def test_grasp_draws_a_hand_on_the_agents_border():
    state = tt.base_state().replace(agent=jnp.array([8, 1], jnp.int32))
    plain = tt.render(state, CELL)
    holds, empty, none = (tt.render(state, CELL, grasp=direction) for direction in (0, 3, 4))
    np.testing.assert_array_equal(none, plain)
    rows, columns = np.nonzero(np.asarray(holds != plain).any(-1))
    assert rows.min() > 7 * CELL
    assert rows.max() < 9 * CELL
    assert (columns // CELL == 1).all()
    assert (np.asarray(holds)[8 * CELL, CELL + CELL // 2] == 255).all()
    assert np.asarray(holds < plain).all(-1).any(), "a black outline"
    assert (np.asarray(empty)[8 * CELL + CELL // 2, 2 * CELL] < 255).any()


def test_the_used_window_has_a_margin_except_at_the_edge():
    rows = ["A...........", "............", ".TT........F", *["............"] * 9]
    states = jax.tree.map(lambda x: x[None], tt.State.from_ascii(rows))
    parts = rendering.used_window(states, 2)
    assert [list(range(24)[part]) for part in parts] == [list(range(8)), list(range(24))]


@pytest.mark.parametrize("size", [0, 2.5, True, "8"])
def test_render_refuses_other_cell_sizes(size):
    with pytest.raises(ValueError, match="cell_size must be"):
        tt.render(tt.base_state(), size)


@pytest.mark.parametrize("grasp", ["up", 0.0, (0, 1)])
def test_render_refuses_other_grasps(grasp):
    with pytest.raises(ValueError, match="grasp must"):
        tt.render(tt.base_state(), 8, grasp=grasp)


def test_episode_frames_show_every_state_and_grasp_and_padding_moves_nothing():
    state = tt.base_state()
    frames = rendering.episode_frames(state, np.array([[0, 0], [0, 3]]), 8)
    assert frames.shape == (3, 96, 96, 3)
    np.testing.assert_array_equal(frames[0], tt.render(state, 8, grasp=0))
    moved = state.replace(agent=state.agent.at[0].add(-1))
    np.testing.assert_array_equal(frames[1], tt.render(moved, 8, grasp=0))
    after = moved.replace(agent=moved.agent.at[1].add(1), tool=moved.tool.at[1].add(1))
    np.testing.assert_array_equal(frames[2], tt.render(after, 8))
    assert len(rendering.episode_frames(state, (), 8)) == 1
    padding = rendering.episode_frames(state, [[-1, -1]] * 2, 8)
    np.testing.assert_array_equal(padding, np.stack([tt.render(state, 8)] * 3))


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        *((actions, "must be integer[") for actions in (5, [3, 7], [[0, 1, 2]])),
        *((actions, "must hold integers") for actions in ([[0.0, 1.0]], [["up", "left"]])),
        ([[0, 1], [2]], "rectangular"),
        *(([[0, 0], pair], f"{pair}") for pair in ((0, 4), (-1, 2), (2, -1), (-2, -2))),
    ],
)
def test_episode_frames_refuse_other_actions(actions, message):
    assert_refused(["action", message], rendering.episode_frames, tt.base_state(), actions)


def test_gif_holds_the_frames(tmp_path):
    state = tt.base_state()
    agents = jnp.array([[9, 1], [9, 2], [9, 3]], jnp.int32)
    frames = [np.asarray(tt.render(state.replace(agent=agent), 8)) for agent in agents]
    path = tmp_path / "episode.gif"
    tt.save_gif(frames, path, fps=10)
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0
        durations = []
        for index, frame in enumerate(frames):
            gif.seek(index)
            durations.append(gif.info["duration"])
            np.testing.assert_array_equal(np.asarray(gif.convert("RGB")), frame)
    assert durations == [100, 100, 1100]


def durations_of(path):
    """Milliseconds of the pictures of a GIF."""
    with Image.open(path) as gif:
        found = []
        for index in range(getattr(gif, "n_frames", 1)):
            gif.seek(index)
            found.append(gif.info["duration"])
    return found


@pytest.mark.parametrize(
    ("fps", "duration"), [(1, 1000), (4, 250), (15, 70), (29.97, 30), (50, 20)]
)
def test_a_gif_plays_at_its_rate(fps, duration, tmp_path):
    flicker = np.zeros((5, 4, 4, 3), np.uint8)
    flicker[1::2] = 255
    tt.save_gif(flicker, tmp_path / "flicker.gif", fps)
    assert durations_of(tmp_path / "flicker.gif") == [*[duration] * 4, duration + 1000]


def test_a_picture_that_stays_the_same_stays_as_long(tmp_path):
    still = np.zeros((6, 4, 4, 3), np.uint8)
    tt.save_gif(still, tmp_path / "still.gif", 4)
    assert durations_of(tmp_path / "still.gif") == [2500]
    still[4:] = 255
    tt.save_gif(still, tmp_path / "two.gif", 4)
    assert durations_of(tmp_path / "two.gif") == [1000, 1500]


@pytest.mark.parametrize(
    ("frames", "options", "message"),
    [
        (np.zeros((2, 4, 4, 3), np.float32), {}, "got float32"),
        (np.zeros((0, 4, 4, 3), np.uint8), {}, "each at least 1, got uint8[0, 4, 4, 3]"),
        (np.zeros((1, 0, 4, 3), np.uint8), {}, "each at least 1, got uint8[1, 0, 4, 3]"),
        ([FRAMES[0], FRAMES[0][1:]], {}, "frames must be uint8[T, height, width, 3]"),
        ("a.gif", {}, "frames must be uint8[T, height, width, 3]"),
        (FRAMES, {"fps": 0}, "from 1 to 50, got 0"),
        (FRAMES, {"fps": 51}, "from 1 to 50, got 51"),
        (FRAMES, {"fps": "4"}, "from 1 to 50, got '4'"),
    ],
)
def test_a_gif_of_impossible_frames_is_refused(frames, options, message, tmp_path):
    assert_refused([message], tt.save_gif, frames, tmp_path / "none.gif", **options)
