"""Distances in a task and lengths of plans, drawn with matplotlib as PNG."""

import os
from collections.abc import Mapping

import jax
import numpy as np

from trap_tube_jax.dynamics import replay
from trap_tube_jax.figures import default_style
from trap_tube_jax.imports import needs_extra
from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.rendering import render
from trap_tube_jax.solver.search import Plan
from trap_tube_jax.state import State, take

with needs_extra("pictures"):
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

CELL_SIZE = 32  # pixels
MOMENTS = 4  # pictures of distances along a plan


@default_style()
def save_distances(
    state: State, plan: Plan, distances: np.ndarray, path: str | os.PathLike[str]
) -> None:
    """Writes a PNG of the distance to the goal over the board, at moments of a plan.

    Tool and food do not move within a picture. A number is the distance to the goal with the agent
    in that cell. The agent's current cell has no number, nor have cells that are unreachable or
    have no way to the goal.

    Args:
      state: the task's first state.
      plan: the task's plan; an unsolvable task has one picture.
      distances: i16[12, 12, 12, 12, 12, 12], the distances of the task's states.
      path: the file to write.
    """
    states = jax.device_get(replay(state, plan.actions))
    last = max(len(plan.actions) - 1, 0)
    times = np.unique(np.linspace(0, last, MOMENTS).round().astype(int))
    boards = [distances[(*states.food[time], *states.tool[time])] for time in times]
    scale = Normalize(0, max(np.max(boards), 1))
    rows = -(-len(times) // 2)
    columns = min(len(times), 2)
    figure = Figure(figsize=(3.8 * columns + 0.7, 4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for axis in axes:
        axis.set_axis_off()
    for axis, time, steps in zip(axes, times, boards, strict=False):
        _draw_distances(axis, take(states, time), steps, scale)
        left = f"steps left: {len(plan.actions) - time}"
        axis.set_title(left if plan.solvable else "unsolvable")
    figure.colorbar(axes[0].images[-1], ax=list(axes), label="steps to the goal", shrink=0.6)
    figure.savefig(path, format="png", dpi=100)


@default_style()
def save_histogram(lengths: Mapping[str, np.ndarray], path: str | os.PathLike[str]) -> None:
    """Writes a PNG with a histogram per task set, by label, of its tasks' shortest plans.

    Lengths are i32[T], -1 for an unsolvable task.
    """
    longest = max(length.max(initial=1) for length in lengths.values())
    figure = Figure(figsize=(7, 1.8 * len(lengths) + 0.6), layout="constrained")
    axes = figure.subplots(len(lengths), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (label, length) in zip(axes, lengths.items(), strict=True):
        solved = length[length >= 0]
        share = np.bincount(solved, minlength=longest + 1) / len(length)
        axis.bar(np.arange(len(share)), 100 * share, width=0.9)
        if len(solved):
            axis.axvline(solved.mean(), color="black", linewidth=1, linestyle="--")
        axis.set_ylabel("% of tasks")
        axis.set_title(f"{label}: {len(length)} tasks", loc="left")
    axes[-1].set_xlabel("steps of the shortest plan (dashed: mean)")
    figure.savefig(path, format="png", dpi=100)


def _draw_distances(axis: Axes, state: State, steps: np.ndarray, scale: Normalize) -> None:
    """Draws the board, and steps i16[12, 12] by the agent's cell on top."""
    extent = (-0.5, BOARD_SIZE - 0.5, BOARD_SIZE - 0.5, -0.5)
    axis.imshow(np.asarray(render(state, CELL_SIZE)), extent=extent)
    shown = np.ma.masked_less(steps, 0)
    shown[tuple(np.asarray(state.agent))] = np.ma.masked  # keeps the agent visible
    axis.imshow(shown, norm=scale, cmap="viridis_r", extent=extent)
    for row, column in np.argwhere(~np.ma.getmaskarray(shown)):
        value = steps[row, column]
        text = axis.text(column, row, str(value), ha="center", va="center", fontsize=8)
        text.set(color="white" if scale(value) > 0.5 else "black", fontweight="bold")
