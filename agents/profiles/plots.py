"""Figures of a profile, 830 pixels wide as pages show them."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

import trap_tube_jax as tt
from agents.files import write_bytes
from agents.profiles.measure import Table
from agents.profiles.tasks import control_layouts
from agents.runs.drawing import COLORS, WIDTH, drawing, make_panels, to_png
from trap_tube_jax.rendering import used_window
from trap_tube_jax.scoring.scores import wilson_interval

MARKERS = "osD^vPX"
PANELS = {  # title and label of the x axis, by part
    "structural": ("Colours: structural transfer", "strength"),
    "perceptual": ("Layouts: perceptual transfer", "strength"),
    "both": ("Layouts and colours", "strength of both transfers"),
    "plan-length": ("{P}, by shortest plan", "steps of the shortest plan"),
}
DODGE = 0.012  # of the x axis, between the points of two policies
COLUMNS = 5  # in the sheet of controls
CELL = 16  # pixels


def save_success(profile: Table, path: Path) -> None:
    """Draws success by strength of transfer and by plan length as PNG, with 95 % intervals.

    `profile` is the result of `measure.profile`, with at least one part of `PANELS`.
    """
    parts = [part for part in PANELS if part in set(profile["part"])]
    policies = list(profile["policy"].unique())
    with drawing(path):
        titles = [PANELS[part][0] for part in parts]
        figure, axes = make_panels(titles, min(len(parts), 2), 2.9, sharex=False)
        for axis, part in zip(axes, parts, strict=True):
            rows = profile[profile["part"] == part]
            x = rows["plan"] if part == "plan-length" else rows["level"].astype(float)
            # Policies with equal success would hide each other.
            shift = np.arange(len(policies)) - (len(policies) - 1) / 2
            shift = dict(zip(policies, DODGE * np.ptp(x) * shift, strict=True))
            for index, (name, groups) in enumerate(rows.groupby("policy", sort=False)):
                percent = 100 * groups["solved"] / groups["tasks"]
                at = x[groups.index] + shift[name]
                style = {"color": COLORS[index % 7], "marker": MARKERS[index % 7], "label": name}
                axis.errorbar(at, percent, _margins(groups), capsize=2, clip_on=False, **style)
            axis.set(xlabel=PANELS[part][1], ylim=(0, 100))
        figure.supylabel("solved, %", fontsize=10)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        write_bytes(path, to_png(figure, dpi=100))


def save_controls(profile: Table, path: Path) -> None:
    """Draws the board of each control as PNG, and below it the percentages of each policy.

    `profile` is the result of `measure.profile`, with the part "control".
    """
    rows = profile[profile["part"] == "control"]
    layouts = control_layouts()
    policies = list(rows["policy"].unique())
    lines = -(-len(layouts) // COLUMNS)
    height = 0.22 * len(policies) + 0.1
    with drawing(path):
        from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

        figure = Figure(figsize=(WIDTH, lines * (height + 1.75)), layout="constrained")
        axes = figure.subplots(2 * lines, COLUMNS, height_ratios=lines * [1.4, height])
        boards = axes[::2].flatten()
        cells = axes[1::2].flatten()
        for axis in axes.flat:
            axis.set_axis_off()
        for index, (level, state) in enumerate(layouts.items()):
            boards[index].imshow(_cropped(state))
            boards[index].set_title(level.replace(", ", ",\n"), fontsize="small")
            names = policies if index % COLUMNS == 0 else []
            _draw_percentages(cells[index], rows[rows["level"] == level], names)
        write_bytes(path, to_png(figure, dpi=100))


def _draw_percentages(axis: Any, groups: Table, names: list[str]) -> None:
    """Draws percent solved and direct, a row for each policy; names the rows."""
    percent = groups[["solved", "direct"]].div(groups["tasks"], axis="index").to_numpy() * 100
    axis.imshow(percent, vmin=0, vmax=100, cmap="cividis", aspect="auto")
    for (row, column), value in np.ndenumerate(percent):
        color = "black" if value > 50 else "white"
        text = {"color": color, "ha": "center", "va": "center", "fontsize": "small"}
        axis.text(column, row, f"{value:.0f}", **text)
    axis.set_axis_on()
    axis.set_yticks(range(len(names)), names, fontsize="small")
    axis.set_xticks([0, 1], ["solved", "direct"], fontsize="x-small")
    axis.tick_params(length=0, pad=1)


def _cropped(state: tt.State) -> np.ndarray:
    """Renders the rows and columns that hold objects, with a margin of one cell."""
    batch = jax.tree.map(lambda x: np.asarray(x)[None], state)
    return np.asarray(tt.render(state, CELL))[used_window(batch, CELL)]


def _margins(groups: Table) -> np.ndarray:
    """Returns f64[2, G], from percent solved to the ends of their 95 % Wilson intervals.

    Groups of a single task have no interval.
    """
    ends = [
        wilson_interval(solved, tasks) if tasks > 1 else 2 * (solved,)
        for solved, tasks in zip(groups["solved"], groups["tasks"], strict=True)
    ]
    return 100 * np.abs(np.transpose(ends) - (groups["solved"] / groups["tasks"]).to_numpy())
