"""Draws figures of tasks: examples of the eight task sets, and distances to the goal."""

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

import trap_tube_jax as tt
from trap_tube_jax.dynamics import replay
from trap_tube_jax.objects import BOARD_SIZE, NUM_OBJECTS, OBJECT_NAMES
from trap_tube_jax.rendering import used_window
from trap_tube_jax.state import take

CHANGES: dict[tt.Transfer, str] = {
    tt.perceptual: "layout",
    tt.structural: "colours",
    tt.symbolic: "tool",
}
DRAWS = 64  # tasks of which the first distinct ones are shown
SHOWN = 2  # distinct tasks per set
CELL_SIZE = 16  # pixels, in the gallery
LARGE_CELL_SIZE = 32  # pixels, under distances
SIGN_SIZE = 48  # pixels
MOMENTS = 4  # pictures of distances along a plan


def draw_gallery() -> Figure:
    """Draws two tasks of each of the paper's sets, and a legend of the objects."""
    rows = len(tt.PAPER_TASK_SETS) // 2
    figure = Figure(figsize=(2.8 * SHOWN + 1, 1.8 * rows + 0.7), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.8 * rows, 0.7))
    sets, legend = parts
    for panel, entry in zip(sets.subfigures(rows, 2).flat, tt.PAPER_TASK_SETS, strict=True):
        changes = ", ".join(CHANGES[transfer] for transfer in entry.transfers)
        title = f"{entry.label}: {changes}" if changes else entry.label
        panel.suptitle(title, x=0.02, ha="left")
        _draw(panel.subplots(1, SHOWN), distinct_tasks(entry.id))
    axes = legend.subplots(1, NUM_OBJECTS)
    _draw(axes, _signs())
    for axis, name in zip(axes, OBJECT_NAMES, strict=True):
        axis.set_title(name, size="medium")
    return figure


def _draw(axes: np.ndarray, pictures: np.ndarray) -> None:
    for axis in axes:
        axis.set_axis_off()
    for axis, picture in zip(axes, pictures, strict=False):
        axis.imshow(picture, interpolation="nearest")


def distinct_tasks(name: str) -> np.ndarray:
    """Draws the first K <= `SHOWN` distinct tasks among `DRAWS`, u8[K, height, width, 3].

    Leaves out rows and columns without objects.
    """
    keys = jax.random.split(jax.random.key(0), DRAWS)
    states, _ = jax.jit(jax.vmap(tt.make(name).reset))(keys)
    pictures = np.asarray(jax.vmap(lambda state: tt.render(state, CELL_SIZE))(states))
    first: dict[bytes, int] = {}
    for index, picture in enumerate(pictures):
        first.setdefault(picture.tobytes(), index)
    shown = np.array(list(first.values())[:SHOWN])
    rows, columns = used_window(take(states, shown), CELL_SIZE)
    return pictures[shown, rows, columns]


def _signs() -> np.ndarray:
    """Cuts the objects out of the base task, u8[8, s, s, 3]."""
    state = tt.base_state()
    cells = np.asarray(tt.render(state, SIGN_SIZE)).reshape(12, SIGN_SIZE, 12, SIGN_SIZE, 3)
    objects = np.asarray(tt.visible_objects(state))
    shown = [np.argwhere(objects == code)[0] for code in range(NUM_OBJECTS)]
    return np.stack([cells[row, :, column] for row, column in shown])


def draw_distances(state: tt.State | None = None) -> Figure:
    """Draws the distance to the goal over the board, at four moments of the shortest plan.

    Tool and food do not move within a picture. A number is the distance to the goal with the agent
    in that cell. The agent's current cell has no number, nor have cells that are unreachable or
    have no way to the goal.

    Args:
      state: the first state of a task with a plan; the base task if absent.
    """
    state = tt.base_state() if state is None else state
    plan = tt.solve(state)
    distances = tt.distances(state)
    states = jax.device_get(replay(state, plan.actions))
    times = np.linspace(0, plan.length - 1, MOMENTS).round().astype(int)
    boards = [distances[(*states.food[time], *states.tool[time])] for time in times]
    scale = Normalize(0, np.max(boards))
    figure = Figure(figsize=(8.3, 8), layout="constrained")
    axes = figure.subplots(2, 2).flatten()
    for axis, time, steps in zip(axes, times, boards, strict=True):
        axis.set_axis_off()
        _draw_distances(axis, take(states, time), steps, scale)
        axis.set_title(f"steps left: {plan.length - time}")
    figure.colorbar(axes[0].images[-1], ax=list(axes), label="steps to the goal", shrink=0.6)
    return figure


def _draw_distances(axis: Axes, state: tt.State, steps: np.ndarray, scale: Normalize) -> None:
    """Draws the board, and steps i16[12, 12] by the agent's cell on top."""
    extent = (-0.5, BOARD_SIZE - 0.5, BOARD_SIZE - 0.5, -0.5)
    axis.imshow(np.asarray(tt.render(state, LARGE_CELL_SIZE)), extent=extent)
    shown = np.ma.masked_less(steps, 0)
    shown[tuple(np.asarray(state.agent))] = np.ma.masked  # keeps the agent visible
    axis.imshow(shown, norm=scale, cmap="viridis_r", extent=extent)
    for row, column in np.argwhere(~np.ma.getmaskarray(shown)):
        value = steps[row, column]
        text = axis.text(column, row, str(value), ha="center", va="center", fontsize=8)
        text.set(color="white" if scale(value) > 0.5 else "black", fontweight="bold")
