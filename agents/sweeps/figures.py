"""Figures of a grid's results, after the paper's figures of experiments 1 and 2."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.files import write_bytes
from agents.runs.drawing import COLORS, drawing, make_panels, to_png
from agents.runs.metrics import Table
from agents.sweeps import tables
from trap_tube_jax.scoring.tasks import label

DPI = 150
MAX_RANGES = 3  # of seeds that a panel can show
LOOKS = [{"color": color, "linestyle": style} for style in ("-", "--", ":") for color in COLORS]


def save(root: Path, results: Table, curves: Table, about: Mapping[str, Any]) -> list[Path]:
    """Writes the figures that the results allow, and returns the files that were drawn.

    See `tables.tables` for the arguments.
    """
    tested = tables.reported(results)
    compared = tables.differences(tested)
    drawn = []
    for name, is_drawn, make in (
        ("curves.png", True, lambda: draw_curves(results, curves, about)),
        ("success.png", len(tested) > 0, lambda: draw_success(tested, about)),
        ("differences.png", len(compared) > 0, lambda: draw_differences(compared, about)),
    ):
        path = root / name
        path.unlink(missing_ok=True)  # it may be of an earlier grid
        if is_drawn:
            with drawing(path):
                write_bytes(path, to_png(make(), DPI))
                drawn.append(path)
    return drawn


def draw_curves(results: Table, curves: Table, about: Mapping[str, Any]) -> Any:
    """Draws percent solved over environment steps: in training, and greedily on every set."""
    train_set = about["train_set"]
    greedy = results[results["purpose"] == "validation"]
    greedy = greedy.assign(value=greedy["solved"] / greedy["tasks"])
    curves = curves.assign(progress=curves["transitions"] / 1e6)
    progress = curves[["algorithm", "seed", "iteration", "progress"]]
    greedy = greedy.merge(progress, on=["algorithm", "seed", "iteration"])
    panels = {
        "training": curves.assign(value=curves["success"]),
        f"greedy, {label(train_set)}": curves.assign(value=curves["validation_success"]),
    }
    for name, rows in greedy.groupby("task_set", sort=False):
        if name != train_set and rows.groupby(["algorithm", "seed"]).size().min() > 1:
            panels[f"greedy, {label(str(name))}"] = rows
    figure, axes = make_panels(list(panels), min(3, len(panels)), 2.1, about["title"])
    names = sorted(curves["algorithm"].unique())  # so that a colour means the same on all pages
    has_ranges = len(names) <= MAX_RANGES
    shown = set()
    for axis, rows in zip(axes, panels.values(), strict=True):
        for name, look in zip(names, itertools.cycle(LOOKS), strict=False):
            curves_of_name = rows[rows["algorithm"] == name]
            if len(curves_of_name):
                shown.add(_draw_seeds(axis, curves_of_name, look, name, has_ranges))
        axis.set_ylim(-3, 103)
    for axis in axes[-min(3, len(axes)) :]:
        axis.set_xlabel("environment steps, millions")
    figure.supylabel(f"solved, %: {' or '.join(sorted(shown))}", fontsize=10)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def draw_success(tested: Table, about: Mapping[str, Any]) -> Any:
    """Draws percent of test tasks solved by set: a bar per algorithm, a point per seed."""
    table = tables.by_set(tested)
    paper = tables.PAPER_SUCCESS if about["train_set"] == "pstsy" else {}
    algorithms = list(tested["algorithm"].unique())
    names = [*algorithms, *paper]
    titles = list(map(label, table))
    figure, axes = make_panels(titles, 5, 0.25 * len(names) + 0.4, about["title"])
    for axis, column in zip(axes, table, strict=True):
        for row, name in enumerate(algorithms):
            values = table.loc[name, column].dropna()
            axis.barh(row, values.mean(), color=COLORS[5])
            axis.plot(values, [row] * len(values), "o", color=COLORS[0], alpha=0.7, markersize=4)
        for row, (means, sds) in enumerate(paper.values(), len(algorithms)):
            if column in tables.PAPER_SETS:
                index = tables.PAPER_SETS.index(column)
                axis.barh(row, means[index], xerr=sds[index], color="#BBBBBB", error_kw={"lw": 1})
                if not means[index]:
                    axis.text(0, row, "0", va="center", fontsize="small")
            else:
                axis.text(0, row, "not reported", va="center", fontsize="small")
        axis.set_xlim(-6, 106)
        axis.set_xticks([0, 50, 100])
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    what = "test tasks solved, %: mean, a point per seed"
    figure.supxlabel(f"{what}; paper: mean ± SD" if paper else what, fontsize=10)
    return figure


def draw_differences(compared: Table, about: Mapping[str, Any]) -> Any:
    """Draws the differences of `tables.differences` by set, with their intervals."""
    names = list(compared["algorithm"].unique())
    sets = list(compared["task_set"].unique())
    height = 0.25 * len(names) + 0.4
    figure, axes = make_panels(list(map(label, sets)), 5, height, about["title"])
    for axis, task_set in zip(axes, sets, strict=True):
        rows = compared[compared["task_set"] == task_set].set_index("algorithm").reindex(names)
        axis.axvline(0, color="black", linewidth=0.8)
        for row, (middle, low, high) in enumerate(rows[["difference", "low", "high"]].to_numpy()):
            axis.plot([low, high], [row, row], color=COLORS[0])
            axis.plot(middle, row, "o", color=COLORS[0], markersize=4)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    what = f"test tasks solved, points above {compared['reference'].iloc[0]}"
    figure.supxlabel(f"{what}: mean and 95 % interval", fontsize=10)
    return figure


def _draw_seeds(axis: Any, rows: Table, look: dict[str, str], name: str, has_range: bool) -> str:
    """Plots the mean of seeds that end at the same iteration, else a line per seed.

    `has_range` adds their range. Returns a description of the lines.
    """
    values = 100 * rows.pivot_table(index="iteration", columns="seed", values="value")
    progress = rows.pivot_table(index="iteration", columns="seed", values="progress")
    if values.shape[1] > 1 and bool(values.iloc[-1].notna().all()):
        together = values.dropna()
        x = progress.loc[together.index].mean(axis=1)
        axis.plot(x, together.mean(axis=1), label=name, **look)
        if not has_range:
            return "mean of seeds"
        low, high = together.min(axis=1), together.max(axis=1)
        axis.fill_between(x, low, high, color=look["color"], alpha=0.1)
        return "mean and range of seeds"
    for count, seed in enumerate(values):
        curve = values[seed].dropna()
        name_once = "" if count else name
        axis.plot(progress.loc[curve.index, seed], curve, label=name_once, linewidth=1.2, **look)
    return "a line per seed"
