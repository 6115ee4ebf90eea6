"""The gallery of task sets and its command line."""

import sys

import jax
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

import trap_tube_jax as tt
from helpers.easy_task import EASY
from helpers.refusal import refused
from trap_tube_jax import gallery
from trap_tube_jax.objects import OBJECT_NAMES
from trap_tube_jax.solver import pictures
from trap_tube_jax.solver.pictures import save_distances, save_histogram


def test_the_gallery_shows_distinct_tasks_of_the_seed_and_a_legend(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **_: figures.append(figure))
    gallery.save_gallery(tmp_path / "none.png", ("base", "sy"), tasks=5, seed=4)
    base, sy, legend = np.split(np.array(figures[0].axes), [5, 10])
    assert [len(axis.images) for axis in base] == [1, 0, 0, 0, 0]
    base_picture = np.asarray(tt.render(tt.base_state(), gallery.CELL_SIZE))
    rows = slice(3 * gallery.CELL_SIZE, 11 * gallery.CELL_SIZE)
    columns = slice(9 * gallery.CELL_SIZE)
    np.testing.assert_array_equal(base[0].images[0].get_array(), base_picture[rows, columns])
    pictures = [np.asarray(axis.images[0].get_array()) for axis in sy]
    assert len({picture.tobytes() for picture in pictures}) == 5
    keys = jax.random.split(jax.random.key(4), gallery.DRAWS)
    state, _ = jax.jit(tt.make("sy").reset)(keys[0])
    np.testing.assert_array_equal(
        pictures[0], np.asarray(tt.render(state, gallery.CELL_SIZE))[rows, columns]
    )
    assert [axis.get_title() for axis in legend] == list(OBJECT_NAMES)
    corners = [np.asarray(axis.images[0].get_array())[5, 1] for axis in legend]
    np.testing.assert_array_equal(corners, tt.base_palette())


def test_a_histogram_shows_shares_of_all_tasks(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(pictures.Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    save_histogram({"one of four has no plan": np.array([4, -1, 8, 8])}, tmp_path / "x.png")
    heights = [bar.get_height() for bar in drawn[0].axes[0].patches]
    assert {steps: height for steps, height in enumerate(heights) if height} == {4: 25, 8: 50}


def test_pictures_are_drawn_under_matplotlibs_defaults(tmp_path, monkeypatch):
    """Here by a reader whose settings ask for a LaTeX that is not there."""
    monkeypatch.setitem(mpl.rcParams, "text.usetex", True)
    monkeypatch.setenv("PATH", "")
    gallery.save_gallery(tmp_path / "gallery.png", ("base",), tasks=2)
    save_histogram({"base": np.array([11])}, tmp_path / "histogram.png")
    plan = tt.solve(EASY)
    save_distances(EASY, plan, tt.distances(EASY), tmp_path / "distances.png")
    assert len(list(tmp_path.iterdir())) == 3
    assert mpl.rcParams["text.usetex"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": 1}, "tasks must be an integer >= 2 and <= 64, got 1"),
        ({"seed": 2**32}, "seed must be an integer >= 0 and <= 4294967295, got 4294967296"),
        ({"ids": ()}, "at least one task set"),
        ({"ids": "base"}, r"at least one task set, as in \('base', 'p'\), got 'base'"),
        ({"ids": ("nonesuch",)}, "unknown task set 'nonesuch'; allowed"),
    ],
)
def test_the_gallery_refuses(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        gallery.save_gallery(tmp_path / "none.png", **options)


def test_the_command_line_writes_the_picture(tmp_path, monkeypatch, capsys):
    given = {}
    monkeypatch.setattr(gallery, "save_gallery", lambda path, **options: given.update(options))
    gallery.main(["--output", str(tmp_path / "new"), "--tasks", "3", "--seed", "5"])
    assert given == {"tasks": 3, "seed": 5}
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "new" / "gallery.png")]


def test_without_matplotlib_the_command_line_names_the_extra(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    words = refused(capsys, gallery.main, "--output", tmp_path)
    assert "pip install 'trap-tube-jax[pictures]'" in words
