"""What the seeds of a record come to together.

Source: paper Tables 1 and 2. Student's t for the interval of a mean of few seeds.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from agents.experiments.records import Record
from trap_tube_jax.scoring.scores import Layouts, Optimality, Score
from trap_tube_jax.scoring.tasks import label

# Quantiles at 0.975 of Student's t with 1, 2, ... degrees of freedom.
STUDENT_T = (
    *(12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281),
    *(2.2010, 2.1788, 2.1604, 2.1448, 2.1314, 2.1199, 2.1098, 2.1009, 2.0930, 2.0860),
    *(2.0796, 2.0739, 2.0687, 2.0639, 2.0595, 2.0555, 2.0518, 2.0484, 2.0452, 2.0423),
)


class Spread(NamedTuple):
    """A mean over seeds.

    Attributes:
      mean: the mean.
      sd: the sample standard deviation; None for one seed, or where the paper gives none.
      margin: half the width of the mean's 95 % confidence interval by Student's t; None
        for one seed, and for the paper.
    """

    mean: float
    sd: float | None = None
    margin: float | None = None

    @classmethod
    def of(cls, values: Sequence[float | None]) -> "Spread | None":
        """That of the known values; None without any."""
        known = [value for value in values if value is not None]
        if not known:
            return None
        mean = float(statistics.fmean(known))
        if len(known) == 1:
            return cls(mean)
        sd = float(statistics.stdev(known))
        return cls(mean, sd, student_t(len(known) - 1) * sd / math.sqrt(len(known)))


class SetSummary(NamedTuple):
    """What the seeds of an algorithm come to on one set.

    Attributes:
      name: the set's short name.
      label: its name in the paper's notation.
      tasks: how many tasks are reported.
      percent: of these, percent solved.
      layouts: by seed, the layouts solved, where the set has few; else None.
      percent_of_solvable: of the tasks known to be solvable, percent solved.
      optimality: mean of shortest length / steps taken, where solved.
      worst: the smallest of these ratios, of all seeds.
    """

    name: str
    label: str
    tasks: int
    percent: Spread | None
    layouts: tuple[Layouts, ...] | None
    percent_of_solvable: Spread | None
    optimality: Spread | None
    worst: float | None


def student_t(degrees: int) -> float:
    """The quantile at 0.975 of Student's t; beyond 30 degrees of freedom its expansion.

    Raises:
      ValueError: there is no degree of freedom.
    """
    if degrees < 1:
        raise ValueError(f"degrees must be >= 1, got {degrees}")
    if degrees <= len(STUDENT_T):
        return STUDENT_T[degrees - 1]
    z = statistics.NormalDist().inv_cdf(0.975)
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + first / degrees + second / degrees**2 + third / degrees**3


def episodes_to_solve(entry: Record) -> list[int]:
    """Of the seeds that solved their training set, the episodes until they first did."""
    firsts = [run["first_solved"] for run in entry["runs"]]
    return [first["episodes"] for first in firsts if first]


def by_set(record: Record, entry: Record) -> dict[str, SetSummary]:
    """What the evaluated seeds of an algorithm come to, by set; empty without any."""
    seeds = [seed_scores(record, entry, run) for run in tested(entry)]
    names = seeds[0] if seeds else ()
    return {name: _summary([scores[name] for scores in seeds]) for name in names}


def mean_of_sets(record: Record, entry: Record) -> Spread | None:
    """Mean percent solved over the sets apart from base, each counting the same."""
    return Spread.of([mean_score(seed_scores(record, entry, run)) for run in tested(entry)])


def mean_score(scores: Mapping[str, Score]) -> float | None:
    """Mean percent solved of a seed over the sets apart from base; None without any."""
    percents = [score.percent for name, score in scores.items() if name != "base"]
    return statistics.fmean(percents) if percents else None


def tested(entry: Record) -> list[Record]:
    """The seeds of an algorithm whose best policy was evaluated on the reported tasks."""
    return [run for run in entry["runs"] if run["best"] and run["best"]["steps"]]


def seed_scores(record: Record, entry: Record, run: Record) -> dict[str, Score]:
    """The scores of a seed's best policy, by set in the record's order."""
    steps = run["best"]["steps"]
    # Earlier records have one limit for all sets, among the settings.
    limits = {
        name: about.get("max_steps", entry["config"]["max_steps"])
        for name, about in record["sets"].items()
    }
    return {
        name: _score(name, np.array(steps[name]), about, limits[name])
        for name, about in record["sets"].items()
        if name in steps
    }


def _score(name: str, steps: np.ndarray, about: Mapping[str, Any], max_steps: int) -> Score:
    solved, optimality, layout = steps > 0, None, about["layout"]
    if about["shortest"]:
        shortest = np.array(about["shortest"])
        part = slice(len(shortest))
        optimality = Optimality.of(solved[part], steps[part], shortest, max_steps)
    if layout is not None:
        layout = np.array(layout)
    return Score.of(name, label(name), solved, steps, layout=layout, optimality=optimality)


def _summary(scores: Sequence[Score]) -> SetSummary:
    compared = [score.optimality for score in scores if score.optimality]
    worst = [found.worst for found in compared if found.worst is not None]
    layouts = tuple(score.layouts for score in scores if score.layouts)
    return SetSummary(
        name=scores[0].set,
        label=scores[0].label,
        tasks=scores[0].tasks,
        percent=Spread.of([score.percent for score in scores]),
        layouts=layouts or None,
        percent_of_solvable=Spread.of([found.percent_of_solvable for found in compared]),
        optimality=Spread.of([found.mean for found in compared]),
        worst=min(worst, default=None),
    )
