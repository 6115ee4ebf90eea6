"""Tables of a grid's results, with the paper's figures alongside.

Source: the paper's Tables 1 and 2; Student's t for the interval of a mean of few seeds.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from agents.runs.metrics import Frame
from trap_tube_jax.scoring.tasks import ALL_SETS, label
from trap_tube_jax.tables import markdown_table

# Table 1: trials solved, episodes to solve.
PAPER_SOLVED = {
    "PPO, paper": ("0 of 5", "–", "–", "–"),
    "PPO + ICM, paper": ("5 of 5", "102,000 ± 60,000", "–", "–"),
}
# Table 2: percent of tasks solved, means and standard deviations of five trials.
PAPER_SETS = ("p", "st", "sy", "pst", "psy", "stsy", "pstsy")
PAPER_SUCCESS = {
    "PPO, paper": ((0, 0, 35.5, 0, 7, 19.4, 4.4), (0, 0, 10.9, 0, 3.6, 3.2, 3.2)),
    "PPO + ICM, paper": ((2, 0, 40.2, 0, 29.7, 33.1, 24.4), (3, 0, 16.9, 0, 8.1, 19.7, 9)),
}
NOTE = (
    "Means over seeds with 95 % intervals (Student's t); the paper's are ± one standard deviation. "
    "A layout counts as solved if more than half of its draws are solved."
)
MEAN = "mean without base"  # over task sets, each counting the same
NOTHING = "–"


def tables(results: Frame, curves: Frame, about: Mapping[str, Any]) -> dict[str, Frame]:
    """Returns the tables by their headings.

    Args:
      results: rows of `agents.results`.
      curves: rows of metrics, with the columns of `report.CURVES`.
      about: `train_set`, which decides the paper's table to compare with, and `threshold`, the
        share of its validation tasks that counts as solved.
    """
    tested, train_set = reported(results), about["train_set"]
    found = {"Training": training_table(curves, about["threshold"], train_set == "base")}
    if len(tested):
        found["Test tasks solved, %"] = success_table(tested, train_set == "pstsy")
    return found


def reported(results: Frame) -> Frame:
    """Returns each seed's newest rows on test tasks, once each, with their `percent` solved."""
    rows = results[results["purpose"] == "test"]
    newest = rows.groupby(["algorithm", "seed"], sort=False)["iteration"].transform("max")
    rows = rows[rows["iteration"] == newest].drop_duplicates(["algorithm", "seed", "task_set"])
    return rows.assign(percent=100 * rows["solved"] / rows["tasks"])


def by_set(tested: Frame) -> Frame:
    """Returns percent solved by algorithm and seed, a column per set and one for their mean."""
    table = tested.pivot(index=["algorithm", "seed"], columns="task_set", values="percent")
    order = [name for name in ALL_SETS if name in table]
    table = table[[*order, *(name for name in table if name not in order)]]
    table[MEAN] = table.drop(columns="base", errors="ignore").mean(axis=1)
    return table.reindex(tested["algorithm"].unique(), level="algorithm")


def training_table(curves: Frame, threshold: float, with_paper: bool) -> Frame:
    """Returns seeds that solved their training set, episodes until they did, and means of costs."""
    columns = ("solved", "episodes to solve", "steps", "minutes")
    rows: dict[Any, tuple[str, ...]] = {}
    for name, own in curves.groupby("algorithm", sort=False):
        episodes = (
            own[own["validation_success"] >= threshold].groupby("seed")["episodes"].min().to_numpy()
        )
        ends = own.groupby("seed")[["transitions", "seconds"]].max()
        steps, seconds = ends.mean()
        solved = f"{len(episodes)} of {len(ends)}"
        rows[name] = (solved, mean_text(episodes, ",.0f"), f"{steps:,.0f}", f"{seconds / 60:,.1f}")
    rows |= PAPER_SOLVED if with_paper else {}
    return pd.DataFrame(rows, columns).T


def success_table(tested: Frame, with_paper: bool) -> Frame:
    """Returns percent solved: a row per set, a column per algorithm."""
    by_task_set = tested.groupby(["algorithm", "task_set"])
    layouts = by_task_set[["layouts", "layouts_total"]].mean().dropna()
    columns: dict[Any, dict[str, str]] = {}
    for name, own in by_set(tested).groupby("algorithm", sort=False):
        columns[name] = {}
        for each, values in own.items():
            text = mean_text(values.to_numpy(), ".1f", high=100)
            if (name, each) in layouts.index:
                solved, total = layouts.loc[(name, each)]
                text = f"{values.mean():.1f} ({solved:.3g} of {total:g})"
            columns[name][each] = text
    for name, paper in PAPER_SUCCESS.items() if with_paper else ():
        columns[name] = {
            each: f"{mean:.1f} ± {sd:.1f}" if sd else f"{mean:.1f}"
            for each, mean, sd in zip(PAPER_SETS, *paper, strict=True)
        }
    return pd.DataFrame(columns).fillna(NOTHING).rename(index=label)


def mean_text(values: Any, form: str, high: float = np.inf) -> str:
    """Formats the mean of known values and, for several, its 95 % interval within [0, high]."""
    values = values[~np.isnan(values)]
    if len(values) < 2:
        return format(values[0], form) if len(values) else NOTHING
    margin = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    low, top = max(0, values.mean() - margin), min(high, values.mean() + margin)
    return f"{values.mean():{form}} [{low:{form}}, {top:{form}}]"


def markdown(table: Frame) -> str:
    """Returns a table as Markdown."""
    heads = ["", *map(str, table.columns)]
    return markdown_table([heads, *([str(name), *row] for name, *row in table.itertuples())])
