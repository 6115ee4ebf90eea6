"""Figures of tasks that pages show."""

import jax
import numpy as np
from matplotlib.text import Text

import trap_tube_jax as tt
from benchmarks import task_pictures
from helpers.easy_task import WORKSHOP
from trap_tube_jax.objects import OBJECT_NAMES

CELL = task_pictures.CELL_SIZE


def test_the_gallery_shows_distinct_tasks_and_a_legend():
    figure = task_pictures.draw_gallery()
    *sets, legend = np.split(np.array(figure.axes), np.arange(2, 17, 2))
    assert [len(axis.images) for axis in sets[0]] == [1, 0], "base has one task"
    window = np.s_[3 * CELL : 11 * CELL, : 9 * CELL]
    base_picture = np.asarray(tt.render(tt.base_state(), CELL))[window]
    np.testing.assert_array_equal(sets[0][0].images[0].get_array(), base_picture)
    for axes in sets[1:]:
        one, other = (np.asarray(axis.images[0].get_array()) for axis in axes)
        assert (one != other).any()
    state, _ = jax.jit(tt.make("sy").reset)(jax.random.split(jax.random.key(0), 64)[0])
    first = sets[3][0].images[0].get_array()
    np.testing.assert_array_equal(first, np.asarray(tt.render(state, CELL))[window])
    titles = [text.get_text() for text in figure.findobj(Text)]
    assert {"base", "{P, Sy}: layout, tool"} < set(titles)
    assert [axis.get_title() for axis in legend] == list(OBJECT_NAMES)
    corners = [np.asarray(axis.images[0].get_array())[5, 1] for axis in legend]
    np.testing.assert_array_equal(corners, tt.base_palette())


def test_pictures_of_distances_count_the_steps_that_are_left(monkeypatch):
    drawn = []
    draw = task_pictures._draw_distances

    def record(axis, state, steps, scale):
        drawn.append((axis, state, steps))
        draw(axis, state, steps, scale)

    monkeypatch.setattr(task_pictures, "_draw_distances", record)
    task_pictures.draw_distances(WORKSHOP)
    assert len(drawn) == task_pictures.MOMENTS
    assert drawn[0][0].get_title() == f"steps left: {tt.solve(WORKSHOP).length}"
    for axis, state, steps in drawn:
        agent = tuple(np.asarray(state.agent).tolist())
        assert axis.get_title() == f"steps left: {steps[agent]}"
        numbers = {text.get_position()[::-1]: int(text.get_text()) for text in axis.texts}
        cells = {tuple(cell) for cell in np.argwhere(steps >= 0).tolist()}
        assert numbers == {cell: steps[cell] for cell in cells - {agent}}
