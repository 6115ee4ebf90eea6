"""The figures of a profile, from its record."""

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.experiments.figures import digest_of, write
from agents.experiments.records import Record
from agents.profiles import summary
from agents.profiles.mistakes import NEVER
from agents.profiles.summary import OUTCOMES, PUSHES, SOLVED, TURNS, Outcome

MEAN_ANGLE = 90  # degrees, from the base colours, at strength 1
COLOURS = ("#1f5f8b", "#d1495b", "#66a182", "#8d6a9f", "#edae49", "#5c5c5c")
MARKERS = "osD^vP"
# Of `OUTCOMES`: solved in greens, failed from yellow to dark red, lost in black.
OUTCOME_COLOURS: dict[str, str] = dict(
    zip(
        OUTCOMES,
        ("#2b7a5b", "#9ccdb0", "#f6dc85", "#eda24e", "#d0623c", "#97303a", "#57202f", "#111111"),
        strict=True,
    )
)
PUSH_COLOURS: dict[str, str] = dict(
    zip(PUSHES, ("#2b7a5b", "#eda24e", "#97303a", "#d9d9d9"), strict=True)
)
TURN_COLOURS = ("#d0623c", "#2b7a5b", "#1f5f8b", "#111111")
COLUMNS = 3  # of panels
BELOW: dict[str, Any] = {  # a legend's place and looks
    "loc": "upper left",
    "bbox_to_anchor": (0, -0.2),
    "ncols": 2,
    "fontsize": "small",
    "frameon": False,
}


def drawings(record: Record, name: str) -> dict[str, Callable[[Path], None]]:
    """What draws each figure of a record, by the name of its file."""
    made = {f"{name}.png": partial(save_profile, record)} if _panels(record) else {}
    for policy in record["policies"]:
        if policy["mistakes"]:
            file = f"{name}_{re.sub('[^A-Za-z0-9-]+', '_', policy['name'])}.png"
            made[file] = partial(save_mistakes, record, policy)
    return made


def digest(record: Record) -> str:
    """That of a record's figures: what they are drawn from."""
    return digest_of(record, sys.modules[__name__], summary)


def save_profile(record: Record, path: Path) -> None:
    """Draws percent solved and optimality over the axes, all policies in one figure, as PNG.

    Args:
      record: of the profile; it holds an axis.
      path: the file to write.
    """
    panels = _panels(record)
    bands = -(-len(panels) // COLUMNS)
    figure = _figure(3.6 * COLUMNS, 4.4 * bands + 0.4)
    for band, part in enumerate(figure.subfigures(bands, 1, squeeze=False)[:, 0]):
        axes = part.subplots(2, COLUMNS, sharex="col", sharey="row", squeeze=False)
        for column, panel in enumerate(panels[band * COLUMNS : (band + 1) * COLUMNS]):
            _draw_panel(record, panel, *axes[:, column])
        for axis in axes.flat:
            axis.set_visible(axis.has_data())
        axes[0, 0].set(ylabel="tasks solved, %", ylim=(-4, 104))
        axes[1, 0].set(ylabel="shortest plan / steps,\nwhere solved", ylim=(-0.04, 1.04))
        if band == 0:
            handles, labels = axes[0, 0].get_legend_handles_labels()
            part.legend(
                handles, labels, loc="outside upper center", ncols=len(labels), frameon=False
            )
    write(figure, path, digest(record))


def save_mistakes(record: Record, policy: Record, path: Path) -> None:
    """Draws what a policy fails at as PNG: outcomes, when plans go wrong, the paired test."""
    names = [*policy["mistakes"]]
    with_pairs = bool(record["pairs"])
    figure = _figure(14 if with_pairs else 9.5, 2.6 + 0.34 * max(len(names), 4))
    figure.suptitle(f"What {policy['name']} fails at", x=0.01, ha="left", fontsize="large")
    axes = figure.subplots(1, 2 + with_pairs)
    counts = {summary.label(name): summary.outcomes(record, policy, name) for name in names}
    _draw_bars(axes[0], counts, OUTCOME_COLOURS, "how episodes end, or how far they come")
    _draw_turns(axes[1], policy, names)
    if with_pairs:
        counts = {
            f"{name} ({len(policy['pushes'][pair[0]]['right'])})": summary.pair_counts(
                record, policy, name
            )
            for name, pair in record["pairs"].items()
        }
        _draw_bars(axes[2], counts, PUSH_COLOURS, "first push in pairs that differ in the trap")
    write(figure, path, digest(record))


def _by_angle(record: Record, policy: Record) -> dict[float, Outcome]:
    found = summary.on_axis(record, policy, "colours")
    return {MEAN_ANGLE * strength: each for strength, each in found.items()}


# Title, unit of x, and what finds the outcomes of a policy.
Panel = tuple[str, str, Callable[[Record, Record], Mapping[Any, Outcome]]]
PANELS: tuple[Panel, ...] = (
    ("other colours", "mean angle from base, degrees", _by_angle),
    ("other layouts", "distance from base, strength", partial(summary.on_axis, axis="layout")),
    ("other layouts and colours", "strength of both", partial(summary.on_axis, axis="both")),
    ("{P}, by length of the plan", "length of the shortest plan", summary.by_length),
    (
        "{P}, by way of the food",
        "way of the food from the agent; tool along or across it",
        summary.by_kind,
    ),
    ("{P, St}, by swap", "tool swapped with", partial(summary.swapped, whole="both 1")),
)


def _panels(record: Record) -> list[Panel]:
    """Those with data."""
    return [panel for panel in PANELS if panel[2](record, record["policies"][0])]


def _draw_panel(record: Record, panel: Panel, solved: Any, optimal: Any) -> None:
    title, unit, find = panel
    for index, policy in enumerate(record["policies"]):
        style = {"color": COLOURS[index % len(COLOURS)], "marker": MARKERS[index % len(MARKERS)]}
        middle = (len(record["policies"]) - 1) / 2
        found = find(record, policy)
        _draw_outcomes(solved, optimal, found, index - middle, label=policy["name"], **style)
    solved.set_title(title, loc="left", fontsize="medium")
    optimal.set_xlabel(unit)
    for axis in (solved, optimal):
        axis.grid(alpha=0.25)


def _draw_outcomes(
    solved: Any,
    optimal: Any,
    outcomes: Mapping[Any, Outcome],
    place: float,
    **style: Any,
) -> None:
    """Percent solved with intervals above, optimality with intervals below; kinds side by side."""
    x = list(outcomes)
    is_kinds = isinstance(x[0], str)
    if is_kinds:
        names = [kind.replace(", ", "\n") for kind in x]
        for axis in (solved, optimal):
            axis.set_xticks(range(len(x)), names, fontsize="x-small")
        x = [at + 0.14 * place for at in range(len(x))]
    style |= {"markersize": 4.5, "linewidth": 0 if is_kinds else 1.4, "elinewidth": 1, "capsize": 2}
    found = list(outcomes.values())
    percents = [each.percent for each in found]
    ends = [each.interval or (each.percent, each.percent) for each in found]
    margins = [[p - low, high - p] for p, (low, high) in zip(percents, ends, strict=True)]
    solved.errorbar(x, percents, np.abs(np.transpose(margins)), **style)
    known = [(at, each.optimality) for at, each in zip(x, found, strict=True) if each.optimality]
    if known:
        means = np.array([spread.mean for _, spread in known])
        margin = np.array([spread.margin or 0.0 for _, spread in known])
        ends = np.stack(
            [means - np.clip(means - margin, 0, 1), np.clip(means + margin, 0, 1) - means]
        )
        optimal.errorbar([at for at, _ in known], means, ends, **style)


def _draw_bars(
    axis: Any, counts: Mapping[str, Mapping[str, int]], colours: Mapping[str, str], title: str
) -> None:
    """Stacked bars of percentages, a bar a row, the first on top."""
    labels = list(counts)
    totals = np.array([max(sum(each.values()), 1) for each in counts.values()])
    left = np.zeros(len(labels))
    for name, colour in colours.items():
        widths = 100 * np.array([each[name] for each in counts.values()]) / totals
        label = f"failed, {name}" if name in OUTCOMES[len(SOLVED) :] else name
        axis.barh(labels, widths, left=left, color=colour, label=label, height=0.72)
        left += widths
    axis.invert_yaxis()
    axis.set_xlim(0, 100)
    axis.set_title(title, loc="left", fontsize="medium")
    axis.spines[["top", "right", "left"]].set_visible(False)
    axis.tick_params(axis="y", length=0)
    axis.set_xlabel("%")
    axis.legend(**BELOW)


def _draw_turns(axis: Any, policy: Record, names: Sequence[str]) -> None:
    """Of all failed episodes, the share in which each turn has come by a step."""
    rows = [row for name in names for row in summary.failed(policy, name)]
    limit = policy["config"]["max_steps"]
    for colour, (turn, text) in zip(TURN_COLOURS, TURNS.items(), strict=True):
        steps = np.sort([row[turn] for row in rows if row[turn] != NEVER])
        share = 100 * np.arange(1, len(steps) + 1) / max(len(rows), 1)
        if len(steps):
            x, y = [0, *steps, limit], [0, *share, share[-1]]
            axis.step(x, y, where="post", color=colour, label=f"{text} ({len(steps)})")
    axis.set_xlim(0, limit)
    axis.set_ylim(0, 103)
    axis.grid(alpha=0.25)
    axis.set_xlabel("step")
    axis.set_ylabel("%, by this step")
    axis.set_title(f"{len(rows)} failed episodes, step by step", loc="left", fontsize="medium")
    if rows:
        axis.legend(**BELOW)


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    return Figure(figsize=(width, height), layout="constrained")
