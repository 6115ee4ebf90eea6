"""Figures of a profile, 830 pixels wide as pages show them."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from agents.profiles.tasks import PARTS, Sampling
from agents.sweeps.figures import COLORS, WIDTH, make_panels
from trap_tube_jax.rendering import render
from trap_tube_jax.scoring.scores import wilson_interval
from trap_tube_jax.state import take

MARKERS = "osD^vPX"
PANELS = {  # part, and the label of its x axis
    "structural": "strength of the structural transfer",
    "perceptual": "strength of the perceptual transfer",
    "both": "strength of both transfers",
    "plan-length": "shortest plan of the task in {P}, steps",
}
COLUMNS = 7  # in the sheet of controls


def save_success(profile: pd.DataFrame, path: Path) -> None:
    """Draws success by strength of transfer and by plan length as PNG, with 95 % intervals.

    `profile` is that of `measure.profile`, with at least one part of `PANELS`.
    """
    parts = [part for part in PANELS if part in set(profile["part"])]
    figure, axes = make_panels(parts, min(len(parts), 2), 2.9, sharex=False)
    for axis, part in zip(axes, parts, strict=True):
        for index, (policy, own) in enumerate(profile.groupby("policy", sort=False)):
            groups = own.query("part == @part")
            x = groups["plan"] if part == "plan-length" else groups["level"].astype(float)
            percent = 100 * groups["solved"] / groups["tasks"]
            style = {"color": COLORS[index % 7], "marker": MARKERS[index % 7], "label": policy}
            axis.errorbar(x, percent, _margins(groups), capsize=2, clip_on=False, **style)
        axis.set(xlabel=PANELS[part], ylim=(0, 100))
    figure.supylabel("solved, %", fontsize=10)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.savefig(path, format="png")


def save_controls(profile: pd.DataFrame, path: Path) -> None:
    """Draws the board of each control as PNG, and below it a heat map of success by policy.

    `profile` is that of `measure.profile`, with the part "control".
    """
    tasks, levels = PARTS["control"](Sampling((), 1, 3))
    policies = list(dict.fromkeys(profile["policy"]))
    rows = -(-len(tasks.time) // COLUMNS)
    height = 0.25 * len(policies)
    figure = Figure(figsize=(WIDTH, rows * (height + 1.9)), layout="constrained")
    axes = figure.subplots(2 * rows, COLUMNS, height_ratios=rows * [1.2, height])
    boards, cells = axes[::2].flatten(), axes[1::2].flatten()
    for index, level in enumerate(levels or ()):
        boards[index].imshow(np.asarray(render(take(tasks, index), 16)))
        boards[index].set_title(level.replace(", ", ",\n"), fontsize="small")
        groups = profile.query("part == 'control' and level == @level")
        share = (groups["solved"] / groups["tasks"]).to_numpy()
        cells[index].imshow(share[:, None], vmin=0, vmax=1, cmap="cividis", aspect="auto")
        for row, (steps, plan) in enumerate(zip(groups["steps"], groups["plan"], strict=True)):
            failed = "no plan" if np.isnan(plan) else "fails"
            text, color = (failed, "white") if np.isnan(steps) else (f"{steps:.0f} steps", "black")
            cells[index].text(0, row, text, color=color, ha="center", va="center", fontsize="small")
        names = policies if index % COLUMNS == 0 else [""] * len(policies)
        cells[index].set_yticks(range(len(policies)), names, fontsize="small")
        cells[index].tick_params(length=0, labelbottom=False)
    for axis in boards:
        axis.set_axis_off()
    figure.savefig(path, format="png")


def _margins(groups: pd.DataFrame) -> np.ndarray:
    """Returns f64[2, G], from percent solved to the ends of their 95 % Wilson intervals.

    Groups of a single task have no interval.
    """
    ends = [
        wilson_interval(solved, tasks) if tasks > 1 else 2 * (solved,)
        for solved, tasks in zip(groups["solved"], groups["tasks"], strict=True)
    ]
    return 100 * np.abs(np.transpose(ends) - (groups["solved"] / groups["tasks"]).to_numpy())
