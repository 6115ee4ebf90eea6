"""The contact sheet and the pictures of episodes."""

import jax
import numpy as np
import pytest
from PIL import Image

import trap_tube_jax as tt
from trap_tube_jax import gallery
from trap_tube_jax.command_line import plain_errors

PANEL = 5 * (96 + 4) - 4


@pytest.fixture(scope="module")
def sheet():
    return np.asarray(gallery.contact_sheet(("base", "sy"), tasks=5, cell_size=8, seed=4))


def tile(sheet, panel, index):
    """The picture of a task: 96 pixels a side, 16 around the panels, 24 above the tasks."""
    left = 16 + panel * (PANEL + 16) + index * (96 + 4)
    return sheet[40:136, left : left + 96]


def test_the_sheet_shows_the_base_and_a_legend(sheet):
    assert sheet.shape == (16 + 120 + 16, 2 * (PANEL + 16) + 16, 3)
    np.testing.assert_array_equal(tile(sheet, 0, 0), tt.render(tt.base_state(), 8))
    shown = {tuple(color) for color in sheet[40:136, 116 : 16 + PANEL].reshape(-1, 3)}
    assert shown >= {tuple(color) for color in tt.base_palette()}


def test_the_sheet_shows_different_tasks_of_the_seed_and_titles(sheet):
    tiles = [tile(sheet, 1, index) for index in range(5)]
    assert len({picture.tobytes() for picture in tiles}) == 5
    keys = jax.random.split(jax.random.key(4), gallery.DRAWS)
    state, _ = jax.jit(tt.make("sy").reset)(keys[0])
    np.testing.assert_array_equal(tiles[0], tt.render(state, 8))
    title = sheet[16:40, 32 + PANEL :]
    assert (title < 128).any()
    assert (sheet[:16] == 255).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": 1}, "tasks must be an integer >= 2, got 1"),
        ({"tasks": 2.5}, "tasks must be an integer >= 2, got 2.5"),
        ({"cell_size": 7}, "cell_size must be an integer >= 8, got 7"),
        ({"cell_size": 8.5}, "cell_size must be an integer >= 8, got 8.5"),
        ({"seed": 2**32}, "seed must be an integer >= 0 and <= 4294967295, got 4294967296"),
        ({"ids": ()}, "at least one task set"),
        ({"ids": "base"}, r"at least one task set, as in \('base', 'p'\), got 'base'"),
        ({"ids": ("nonesuch",)}, "unknown task set 'nonesuch'; allowed"),
    ],
)
def test_the_sheet_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        gallery.contact_sheet(**options)


def test_a_solved_episode_ends_on_the_food():
    frames = gallery.solved_episode(tt.base_state(), 1)
    assert len(frames) == 12
    food, agent = tt.base_palette()[[5, 7]]
    assert (frames[0] == food).all(-1).any()
    assert not (frames[-1] == food).all(-1).any()
    assert (frames[-1] == agent).all(-1).sum() == 1


def test_no_episode_of_an_unsolvable_task():
    board = np.zeros((12, 12), np.uint8)
    board[[0, 1, 1], [1, 0, 1]] = 3
    state = tt.State.create(board=board, agent=(9, 9), tool=(5, 5), tool_extent=(1, 1), food=(0, 0))
    with pytest.raises(ValueError, match="no solution"):
        gallery.solved_episode(state, 1)


def test_the_command_line_writes_the_pictures(tmp_path, monkeypatch, capsys):
    given, drawn = {}, []

    def sheet(**options):
        given.update(options)
        return Image.new("RGB", (4, 4))

    def episode(state):
        drawn.append(state.tool)
        return np.zeros((1, 4, 4, 3), np.uint8)

    monkeypatch.setattr(gallery, "contact_sheet", sheet)
    monkeypatch.setattr(gallery, "solved_episode", episode)
    monkeypatch.setattr(gallery, "SOLVED_SETS", ("sy",))
    options = {"tasks": 3, "cell_size": 9, "seed": 5}
    gallery.main(gallery.Arguments(out=tmp_path / "new", gifs=True, **options))
    assert given == options
    state, _ = jax.jit(tt.make("sy").reset)(jax.random.key(5))
    np.testing.assert_array_equal(drawn, [state.tool])
    written = [path.name for path in sorted((tmp_path / "new").iterdir())]
    assert written == ["gallery.png", "solved_sy.gif"]
    assert "solved_sy.gif" in capsys.readouterr().out


@pytest.mark.parametrize("error", [ValueError("no such set"), PermissionError("no such folder")])
def test_command_lines_say_in_a_line_what_is_wrong(error, capsys):
    with pytest.raises(SystemExit, match="2"), plain_errors():
        raise error
    assert capsys.readouterr().err == f"error: {error}\n"
