"""The figures of the experiments, from their records.

Source: the paper's figures of experiments 1 and 2.
"""

import hashlib
import inspect
import json
import sys
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.experiments import tables
from agents.experiments.records import Record, rows_of
from agents.runs.metrics import Row
from agents.runs.report import over_episodes
from agents.runs.tracking import GREEDY, OVERALL
from trap_tube_jax.scoring.tasks import ALL_SETS, label

Curves = Mapping[str, Sequence[Row]]  # by algorithm, the rows of all its seeds

WIDTH = 3.2  # inches of a panel
HEIGHT = 2.5
DPI = 110
MOST_SHADED = 3  # algorithms whose spread is shown too
SMOOTHED = 10  # points of a curve of training, over which `_save_success` takes means
DIGEST = "Drawn from"  # the key of a figure's metadata


def save(record: Record, path: Path) -> None:
    """Draws the learning curves of a record as PNG, which carries its `digest`."""
    curves = {
        tables.algorithm_label(record, entry): [
            row for run in entry["runs"] for row in rows_of(run)
        ]
        for entry in record["algorithms"]
    }
    draw = save_rewards if record["experiment"] == "exp1" else _save_success
    draw(curves, path, tables.title(record), record)


def drawings(record: Record, name: str) -> dict[str, Callable[[Path], None]]:
    """What draws each figure of a record, by the name of its file."""
    return {f"{name}.png": partial(save, record)}


def write(figure: Any, path: Path, drawn_from: str | None) -> None:
    """Writes a figure as PNG, which carries the digest of what it is drawn from."""
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {} if drawn_from is None else {DIGEST: drawn_from}
    figure.savefig(path, format="png", dpi=DPI, metadata=metadata)


def digest(record: Record) -> str:
    """That of a record's figures: what they are drawn from."""
    return digest_of(record, sys.modules[__name__], over_episodes)


def digest_of(record: Record, *code: Any) -> str:
    """A SHA-256 of a record and of the source of the modules and functions that draw it."""
    parts = (json.dumps(record, sort_keys=True), *map(inspect.getsource, code))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def drawn_from(path: Path) -> str | None:
    """The digest of what a figure was drawn from; None if it names none."""
    from PIL import Image  # noqa: PLC0415  slow to import

    if not path.is_file():
        return None
    with Image.open(path) as picture:
        return picture.info.get(DIGEST)


def save_rewards(curves: Curves, path: Path, title: str, record: Record | None = None) -> None:
    """As in experiment 1: training and evaluation reward over episodes, a thin line per seed."""
    panels = {"training reward": "success", "greedy evaluation reward": "evaluation"}
    _save(curves, panels, path, title, record, columns=2, draw=_draw_seeds)


def _save_success(curves: Curves, path: Path, title: str, record: Record) -> None:
    """Experiment 2: mean ± sd and maximum over seeds, of training and of every set.

    Of many algorithms the mean alone: spreads would cover each other.
    """
    columns = dict.fromkeys(name for rows in curves.values() for row in rows for name in row)
    found = [name.removeprefix(GREEDY) for name in columns if name.startswith(GREEDY)]
    sets = [name for name in ALL_SETS if name in found]
    sets += [name for name in found if name not in ALL_SETS and GREEDY + name != OVERALL]
    panels = {"training, running mean": "success", **{label(name): GREEDY + name for name in sets}}
    if OVERALL in columns:
        panels["overall"] = OVERALL
    is_few = len(curves) <= MOST_SHADED
    title += ": mean, ± sd, maximum (dotted)" if is_few else ": mean over seeds"
    draw = partial(_draw_spread, shaded=is_few)
    shown = {name: smoothed(rows) for name, rows in curves.items()}
    _save(shown, panels, path, title, record, columns=5, draw=draw)


def smoothed(rows: Sequence[Row]) -> list[Row]:
    """The rows, success in training averaged over the last ones of its seed."""
    newest: dict[float, deque[float]] = defaultdict(lambda: deque(maxlen=SMOOTHED))
    made: list[Row] = []
    for row in rows:
        if "success" in row:
            newest[row["seed"]].append(row["success"])
            row = {**row, "success": float(np.mean(newest[row["seed"]]))}  # noqa: PLW2901
        made.append(row)
    return made


def by_episodes(rows: Sequence[Row], metric: str) -> tuple[np.ndarray, np.ndarray]:
    """The episodes f64[n] and the values f64[S, n] of a metric; iterations without it left out.

    Seeds that have not come as far are NaN.
    """
    seeds = sorted({row["seed"] for row in rows})
    known = [row for row in rows if not np.isnan(row.get(metric, np.nan))]
    episodes = sorted({row["episodes"] for row in known})
    values = np.full((len(seeds), len(episodes)), np.nan)
    for row in known:
        values[seeds.index(row["seed"]), episodes.index(row["episodes"])] = row[metric]
    return np.array(episodes, np.float64), values


def _save(
    curves: Curves,
    panels: Mapping[str, str],
    path: Path,
    title: str,
    record: Record | None,
    *,
    columns: int,
    draw: Callable[..., None],
) -> None:
    columns = min(columns, len(panels))
    figure, axes = over_episodes([*panels], columns, (WIDTH, HEIGHT), title, sharey=True)
    for axis, metric in zip(axes, panels.values(), strict=True):
        for index, (algorithm, rows) in enumerate(curves.items()):
            draw(axis, *by_episodes(rows, metric), color=f"C{index}", label=algorithm)
        axis.set_ylim(-0.03, 1.03)
    lines, names = axes[0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside lower center", ncols=len(names), fontsize="small")
    write(figure, path, None if record is None else digest(record))


def _draw_seeds(axis: Any, episodes: np.ndarray, values: np.ndarray, **style: Any) -> None:
    """Every seed as a thin line, and their mean; without it where some stopped earlier."""
    shared, complete = _of_all_seeds(episodes, values)
    all_end_together = len(shared) == len(episodes)
    if all_end_together:
        axis.plot(shared, np.mean(complete, axis=0), linewidth=1.6, **style)
    if len(values) > 1:
        label = None if all_end_together else style["label"]
        for row in values:
            known = ~np.isnan(row)
            axis.plot(
                episodes[known], row[known], color=style["color"], linewidth=0.8,
                alpha=0.35 if all_end_together else 0.7, label=label,
            )  # fmt: skip
            label = None


def _draw_spread(
    axis: Any, episodes: np.ndarray, values: np.ndarray, *, shaded: bool, **style: Any
) -> None:
    """Mean as a line; if shaded one deviation on either side as a band, maximum dotted."""
    color = style["color"]
    shared, complete = _of_all_seeds(episodes, values)
    mean = np.mean(complete, axis=0)
    axis.plot(shared, mean, linewidth=1.6, **style)
    if shaded and len(values) > 1:
        deviation = np.std(complete, axis=0, ddof=1)
        axis.fill_between(
            shared, mean - deviation, mean + deviation, color=color, alpha=0.2, linewidth=0
        )
        axis.plot(episodes, np.nanmax(values, axis=0), color=color, linewidth=0.9, linestyle=":")


def _of_all_seeds(episodes: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The points that every seed has, for a mean over some of the seeds would mislead."""
    complete = ~np.isnan(values).any(axis=0)
    return episodes[complete], values[:, complete]
