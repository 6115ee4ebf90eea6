"""Tables of a grid's results, with the paper's figures alongside.

Source: the paper's Tables 1 and 2; Student's t for the interval of a mean of few seeds; Welch
(1947) and Holm (1979) for differences between algorithms.
"""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from agents.runs.metrics import Table
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
    "A layout counts as solved if more than half of its draws are solved. Differences have 95 % "
    "intervals of Welch's t-test, corrected by Holm's method for the comparisons in a row, and "
    "none where scores do not vary; * marks p < 0.05. The mean counts the sets that all columns "
    "share."
)
MEAN = "mean without base"  # over the task sets of all algorithms, each counting the same
ROUNDING = 1e-9  # percent, a spread of means that rounding explains
NOTHING = "–"


def tables(results: Table, curves: Table, about: Mapping[str, Any]) -> dict[str, Table]:
    """Returns the tables by their headings.

    Args:
      results: rows of `agents.results`.
      curves: rows of metrics, with the columns of `records.CURVES`.
      about: `train_set`, which decides the paper's table to compare with, `threshold`, the share of
        its validation tasks that counts as solved.
    """
    tested = reported(results)
    train_set = about["train_set"]
    with_paper = train_set == "base"
    threshold = about["threshold"]
    share = "" if threshold == 1 else f"; solved: {100 * threshold:g} % of the tasks"
    found = {f"Training{share}": training_table(curves, threshold, with_paper)}
    if len(tested):
        found["Test tasks solved, %"] = success_table(tested, train_set == "pstsy")
    compared = differences(tested)
    if len(compared):
        heading = f"Difference from {compared['reference'].iloc[0]}, points"
        found[heading] = difference_table(compared)
    return found


def unfinished_note(about: Mapping[str, Any]) -> list[str]:
    """Names the runs that have not reached their end, in one sentence; none if all have."""
    runs = [f"{algorithm} seed {seed}" for algorithm, seed in about["unfinished"]]
    return [f"Unfinished, so the table may change: {', '.join(runs)}."] if runs else []


def reported(results: Table) -> Table:
    """Returns the newest rows on test tasks by seed, without repeats, with `percent` solved."""
    rows = results[results["purpose"] == "test"]
    newest = rows.groupby(["algorithm", "seed"], sort=False)["iteration"].transform("max")
    rows = rows[rows["iteration"] == newest].drop_duplicates(["algorithm", "seed", "task_set"])
    return rows.assign(percent=100 * rows["solved"] / rows["tasks"])


def by_set(tested: Table) -> Table:
    """Returns percent solved by algorithm and seed, a column per set and one for their mean.

    The mean is over the sets that every algorithm has; a seed that lacks one of them has no mean.
    """
    table = tested.pivot(index=["algorithm", "seed"], columns="task_set", values="percent")
    order = [name for name in ALL_SETS if name in table]
    table = table[[*order, *(name for name in table if name not in order)]]
    is_shared = table.notna().groupby(level="algorithm").any().all()
    shared = [name for name in table if is_shared[name] and name != "base"]
    if shared:
        table[MEAN] = table[shared].mean(axis=1, skipna=False)
    return table.reindex(tested["algorithm"].unique(), level="algorithm")


def training_table(curves: Table, threshold: float, with_paper: bool) -> Table:
    """Returns seeds that solved their training set, episodes until they did, and means of costs."""
    columns = ("solved", "episodes to solve", "steps", "minutes")
    rows: dict[Any, tuple[str, ...]] = {}
    for name, found in curves.groupby("algorithm", sort=False):
        solving = found[found["validation_success"] >= threshold]
        episodes = solving.groupby("seed")["episodes"].min().to_numpy()
        ends = found.groupby("seed")[["transitions", "seconds"]].max()
        rows[name] = (
            f"{len(episodes)} of {len(ends)}",
            mean_text(episodes, ",.0f"),
            f"{ends['transitions'].mean():,.0f}",
            f"{ends['seconds'].mean() / 60:,.1f}",
        )
    rows |= PAPER_SOLVED if with_paper else {}
    return pd.DataFrame(rows, columns).T


def success_table(tested: Table, with_paper: bool) -> Table:
    """Returns percent solved: a row per set, a column per algorithm."""
    by_task_set = tested.groupby(["algorithm", "task_set"])
    layouts = by_task_set[["layouts", "layouts_total"]].mean().dropna()
    columns: dict[Any, dict[str, str]] = {}
    for name, found in by_set(tested).groupby("algorithm", sort=False):
        columns[name] = {}
        for column, values in found.items():
            text = mean_text(values.to_numpy(), ".1f", high=100)
            if (name, column) in layouts.index:
                solved, total = layouts.loc[(name, column)]
                text = f"{values.mean():.1f} ({solved:.3g} of {total:g})"
            columns[name][column] = text
    for name, paper in PAPER_SUCCESS.items() if with_paper else ():
        columns[name] = {
            short: f"{mean:.1f} ± {sd:.1f}" if sd else f"{mean:.1f}"
            for short, mean, sd in zip(PAPER_SETS, *paper, strict=True)
        }
    table = pd.DataFrame(columns).fillna(NOTHING)
    return table.rename(index=label)


def differences(tested: Table) -> Table:
    """Compares the percent solved by every algorithm with the first one's.

    Leaves out algorithms of one seed, and sets of few layouts, where a seed solves all or nothing.

    Returns:
      A row per task set and algorithm: `task_set`, `reference` and `algorithm`, the `difference` of
      their means over seeds, `low` and `high` of its 95 % interval, and `p` of Welch's t-test.
      Interval and p are corrected by Holm's method for the comparisons in a task set, and unknown
      where neither algorithm varies.
    """
    seeds = tested.groupby("algorithm", sort=False)["seed"].nunique()
    several = list(seeds[seeds > 1].index)
    if len(several) < 2 or several[0] != seeds.index[0]:
        return pd.DataFrame()
    reference = several[0]
    few_layouts = tested.loc[tested["layouts_total"].notna(), "task_set"].unique()
    rows = []
    for task_set, percents in by_set(tested).drop(columns=few_layouts).items():
        known = {name: percents[name].dropna().to_numpy() for name in several}
        if len(known[reference]) < 2:
            continue
        others = [name for name in several[1:] if len(known[name]) > 1]
        tests = [welch(known[name], known[reference]) for name in others]
        factors = holm_factors(np.array([p for *_, p in tests]))
        for name, test, factor in zip(others, tests, factors, strict=True):
            difference, error, freedom, p = test
            margin = stats.t.isf(0.025 / factor, freedom) * error
            low = difference - margin
            high = difference + margin
            corrected = np.minimum(1.0, factor * p)
            rows.append((task_set, reference, name, difference, low, high, corrected))
    columns = ["task_set", "reference", "algorithm", "difference", "low", "high", "p"]
    return pd.DataFrame(rows, columns=columns)


def welch(a: Any, b: Any) -> tuple[float, float, float, float]:
    """Compares the means of two samples by Welch's t-test.

    Returns mean(a) - mean(b), its standard error, the degrees of freedom, and p; NaN for the last
    three if neither sample varies.
    """
    if max(np.ptp(a), np.ptp(b)) < ROUNDING:
        return a[0] - b[0], np.nan, np.nan, np.nan
    parts = np.array([x.var(ddof=1) / len(x) for x in (a, b)])
    difference = a.mean() - b.mean()
    error = np.sqrt(parts.sum())
    freedom = error**4 / np.sum(parts**2 / [len(a) - 1, len(b) - 1])
    p = 2 * float(stats.t.sf(abs(difference) / error, freedom))
    return difference, error, freedom, p


def holm_factors(p: Any) -> Any:
    """Returns the factors f64[M] by which Holm's method corrects M values of p.

    The i-th smallest counts M + 1 - i times, and more if its product would not exceed a smaller
    p's. The 100 (1 - 0.05 / factor) % interval excludes 0 exactly where factor * p < 0.05. Values
    that are NaN do not count, and have the factor NaN.
    """
    known = ~np.isnan(p)
    if not known.all():
        factors = np.full(len(p), np.nan)
        factors[known] = holm_factors(p[known])
        return factors
    order = np.argsort(p)
    counts = np.arange(len(p), 0, -1.0)
    factors = np.empty(len(p))
    products = np.maximum.accumulate(counts * p[order])
    factors[order] = np.divide(products, p[order], out=counts, where=p[order] > 0)
    return factors


def difference_table(compared: Table) -> Table:
    """Formats `differences`: a row per set, a column per algorithm; * marks p < 0.05."""
    shown = [
        f"{row.difference:+z.1f}"
        + ("" if np.isnan(row.p) else f" [{row.low:z.1f}, {row.high:z.1f}]")
        + ("*" if row.p < 0.05 else "")
        for row in compared.itertuples()
    ]
    table = compared.assign(shown=shown).pivot(
        index="task_set", columns="algorithm", values="shown"
    )
    table = table.loc[compared["task_set"].unique(), compared["algorithm"].unique()]
    return table.fillna(NOTHING).rename_axis(index=None, columns=None).rename(index=label)


def mean_text(values: Any, form: str, high: float = np.inf) -> str:
    """Formats the mean of known values and, for several, its 95 % interval within [0, high]."""
    values = values[~np.isnan(values)]
    if len(values) < 2:
        return format(values[0], form) if len(values) else NOTHING
    margin = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    low = max(0, values.mean() - margin)
    top = min(high, values.mean() + margin)
    return f"{values.mean():{form}} [{low:{form}}, {top:{form}}]"


def markdown(table: Table) -> str:
    """Returns a table as Markdown."""
    heads = ["", *map(str, table.columns)]
    return markdown_table([heads, *([str(name), *row] for name, *row in table.itertuples())])


def escape(text: str) -> str:
    """Returns text that Markdown shows as it is, without HTML and links."""
    return re.sub(r"[\\`*\[\]<>&|]", r"\\\g<0>", text)
