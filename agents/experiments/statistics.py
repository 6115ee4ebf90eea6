"""What the seeds of a record come to together.

Source: paper Tables 1 and 2. Student's t for the interval of a mean of few seeds.
"""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from agents.experiments.records import Record
from trap_tube_jax.scoring.scores import Layouts, Optimality, Score
from trap_tube_jax.scoring.tasks import label


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
        return cls(mean, sd, float(stdtrit(len(known) - 1, 0.975)) * sd / math.sqrt(len(known)))


class SetSummary(NamedTuple):
    """What the seeds of an algorithm come to on one set.

    Attributes:
      percent: of the reported tasks, percent solved.
      layouts: by seed, the layouts solved; empty unless the set has few.
      percent_of_solvable: of the tasks known to be solvable, percent solved.
      optimality: mean of shortest length / steps taken, where solved.
      worst: the smallest of these ratios, of all seeds.
    """

    percent: Spread | None
    layouts: tuple[Layouts, ...]
    percent_of_solvable: Spread | None
    optimality: Spread | None
    worst: float | None


def episodes_to_solve(entry: Record) -> list[int]:
    """Of the seeds that solved their training set, the episodes until they first did."""
    firsts = [run["first_solved"] for run in entry["runs"]]
    return [first["episodes"] for first in firsts if first]


def by_set(record: Record, entry: Record) -> dict[str, SetSummary]:
    """What the evaluated seeds of an algorithm come to, by set; empty without any."""
    seeds = [seed_scores(record, run) for run in tested(entry)]
    names = seeds[0] if seeds else ()
    return {name: _summary([scores[name] for scores in seeds]) for name in names}


def mean_of_sets(record: Record, entry: Record) -> Spread | None:
    """Mean percent solved over the sets apart from base, each counting the same."""
    return Spread.of([mean_score(seed_scores(record, run)) for run in tested(entry)])


def mean_score(scores: Mapping[str, Score]) -> float | None:
    """Mean percent solved of a seed over the sets apart from base; None without any."""
    percents = [score.percent for name, score in scores.items() if name != "base"]
    return statistics.fmean(percents) if percents else None


def tested(entry: Record) -> list[Record]:
    """The seeds of an algorithm whose best policy was evaluated on the reported tasks."""
    return [run for run in entry["runs"] if run["best"] and run["best"]["steps"]]


def seed_scores(record: Record, run: Record) -> dict[str, Score]:
    """The scores of a seed's best policy, by set in the record's order."""
    steps = run["best"]["steps"]
    return {
        name: _score(name, np.array(steps[name]), about) for name, about in record["sets"].items()
    }


def _score(name: str, steps: np.ndarray, about: Mapping[str, Any]) -> Score:
    solved, optimality, layout = steps > 0, None, about["layout"]
    if about["shortest"]:
        shortest = np.array(about["shortest"])
        part = slice(len(shortest))
        optimality = Optimality.of(solved[part], steps[part], shortest, about["max_steps"])
    if layout is not None:
        layout = np.array(layout)
    return Score.of(name, label(name), solved, steps, layout=layout, optimality=optimality)


def _summary(scores: Sequence[Score]) -> SetSummary:
    compared = [score.optimality for score in scores if score.optimality]
    return SetSummary(
        percent=Spread.of([score.percent for score in scores]),
        layouts=tuple(score.layouts for score in scores if score.layouts),
        percent_of_solvable=Spread.of([found.percent_of_solvable for found in compared]),
        optimality=Spread.of([found.mean for found in compared]),
        worst=min((found.worst for found in compared if found.worst is not None), default=None),
    )
