"""The contact sheet of task sets."""

import jax
import numpy as np
import pytest

import trap_tube_jax as tt
from trap_tube_jax.contact_sheet import DRAWS, contact_sheet

PANEL = 5 * (96 + 4) - 4


@pytest.fixture(scope="module")
def sheet():
    return np.asarray(contact_sheet(("base", "sy"), tasks=5, cell_size=8, seed=4))


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
    keys = jax.random.split(jax.random.key(4), DRAWS)
    state, _ = jax.jit(tt.make("sy").reset)(keys[0])
    np.testing.assert_array_equal(tiles[0], tt.render(state, 8))
    title = sheet[16:40, 32 + PANEL :]
    assert (title < 128).any()
    assert (sheet[:16] == 255).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": 1}, "tasks must be an integer >= 2, got 1"),
        ({"cell_size": 8.5}, "cell_size must be an integer >= 8, got 8.5"),
        ({"seed": 2**32}, "seed must be an integer >= 0 and <= 4294967295, got 4294967296"),
        ({"ids": ()}, "at least one task set"),
        ({"ids": "base"}, r"at least one task set, as in \('base', 'p'\), got 'base'"),
        ({"ids": ("nonesuch",)}, "unknown task set 'nonesuch'; allowed"),
    ],
)
def test_the_sheet_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        contact_sheet(**options)
