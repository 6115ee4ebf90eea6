"""The pictures of solved episodes, and the command line."""

import jax
import numpy as np
import pytest
from PIL import Image

import trap_tube_jax as tt
from trap_tube_jax import gallery


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

    monkeypatch.setattr("trap_tube_jax.contact_sheet.contact_sheet", sheet)
    monkeypatch.setattr(gallery, "solved_episode", episode)
    monkeypatch.setattr(gallery, "SOLVED_SETS", ("sy",))
    folder = tmp_path / "new"
    options = ["--tasks", "3", "--cell-size", "9", "--seed", "5", "--gifs"]
    gallery.main(["--output", str(folder), *options])
    assert given == {"tasks": 3, "cell_size": 9, "seed": 5}
    state, _ = jax.jit(tt.make("sy").reset)(jax.random.key(5))
    np.testing.assert_array_equal(drawn, [state.tool])
    files = [folder / "gallery.png", folder / "solved_sy.gif"]
    assert sorted(folder.iterdir()) == files
    assert capsys.readouterr().out.splitlines() == [str(file) for file in files]
