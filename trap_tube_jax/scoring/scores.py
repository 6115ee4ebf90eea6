"""Scores of play on fixed tasks: the share solved, its interval, and optimality.

Source: protocol.md, "What is reported".
"""

import dataclasses
import math
from typing import Any

import numpy as np

NORMAL_QUANTILE_95 = 1.959963984540054


@dataclasses.dataclass(frozen=True)
class Optimality:
    """How the solved episodes compare with shortest plans.

    Attributes:
      solvable: tasks that some plan within the step limit solves.
      percent_of_solvable: of those, percent solved; None if there are none.
      mean: mean of shortest length / steps taken over solved tasks; None if there are none.
      worst: the smallest of these ratios.
    """

    solvable: int
    percent_of_solvable: float | None
    mean: float | None
    worst: float | None

    @classmethod
    def of(
        cls, solved: np.ndarray, length: np.ndarray, shortest: np.ndarray, max_steps: int
    ) -> "Optimality":
        """Compares bool[B] and i32[B] with shortest lengths i32[B], -1 where unsolvable."""
        solvable = (shortest >= 0) & (shortest <= max_steps)
        ratio = shortest[solved] / np.maximum(length[solved], 1)
        return cls(
            solvable=int(solvable.sum()),
            percent_of_solvable=100 * float(solved[solvable].mean()) if solvable.any() else None,
            mean=float(ratio.mean()) if len(ratio) else None,
            worst=float(ratio.min()) if len(ratio) else None,
        )


@dataclasses.dataclass(frozen=True)
class Layouts:
    """The layouts of a set that has few of them, whatever their colours.

    Attributes:
      solved: how many are solved in more than half of their draws.
      total: how many the draws hold.
    """

    solved: int
    total: int

    @classmethod
    def of(cls, solved: np.ndarray, layout: np.ndarray) -> "Layouts":
        """Counts the layouts i32[B] of outcomes bool[B]."""
        shares = [float(np.mean(solved[layout == each])) for each in np.unique(layout)]
        return cls(sum(share > 0.5 for share in shares), len(shares))

    def __str__(self) -> str:
        return f"{self.solved} of {self.total}"


@dataclasses.dataclass(frozen=True)
class Score:
    """Play on the fixed tasks of one set.

    Attributes:
      set: the set's short name.
      label: its name in the paper's notation.
      tasks: how many tasks were tried.
      solved: how many were solved.
      percent: 100 solved / tasks.
      interval: 95 % Wilson interval of the percentage over the set's tasks; None where the
        set has few layouts, so that its draws are no sample of many tasks.
      mean_steps: mean steps of the solved episodes; None without any.
      layouts: the layouts solved, where the set has few.
      optimality: the comparison with shortest plans, if one was made.
    """

    set: str
    label: str
    tasks: int
    solved: int
    percent: float
    interval: tuple[float, float] | None
    mean_steps: float | None
    layouts: Layouts | None = None
    optimality: Optimality | None = None

    @classmethod
    def of(
        cls,
        name: str,
        label: str,
        solved: np.ndarray,
        length: np.ndarray,
        *,
        layout: np.ndarray | None = None,
        optimality: Optimality | None = None,
    ) -> "Score":
        """The score of outcomes bool[B] and lengths i32[B].

        Args:
          name: the set's short name.
          label: its name in the paper's notation.
          solved: bool[B].
          length: i32[B], steps taken.
          layout: i32[B], the layout of each task, where the set has few; None elsewhere.
          optimality: the comparison with shortest plans, if one was made.
        """
        count, tasks = int(np.sum(solved)), len(solved)
        low, high = wilson_interval(count, tasks)
        return cls(
            set=name,
            label=label,
            tasks=tasks,
            solved=count,
            percent=100 * count / tasks,
            interval=(100 * low, 100 * high) if layout is None else None,
            mean_steps=float(np.mean(length[solved])) if count else None,
            layouts=None if layout is None else Layouts.of(solved, layout),
            optimality=optimality,
        )


@dataclasses.dataclass(frozen=True)
class Scores:
    """What an agent reaches under the benchmark's protocol. Print it for a table in Markdown.

    Attributes:
      protocol: the version of the fixed tasks.
      version: that of this package.
      seed: of the draws of the agent's actions; None where it made its own.
      sets: the score of every set.
    """

    protocol: int
    version: str
    seed: int | None
    sets: tuple[Score, ...]

    def __getitem__(self, name: str) -> Score:
        """The score of the set with this short name.

        Raises:
          ValueError: the set was not scored.
        """
        by_name = {score.set: score for score in self.sets}
        if name not in by_name:
            raise ValueError(f"no score of {name!r}; allowed: {', '.join(by_name)}")
        return by_name[name]

    def to_dict(self) -> dict[str, Any]:
        """All of it as plain values, for JSON; `sets` is a list of records."""
        return {**dataclasses.asdict(self), "sets": list(map(dataclasses.asdict, self.sets))}

    def __str__(self) -> str:
        heads = ["set", "tasks", "solved", "%", "95 % interval", "layouts", "steps"]
        if any(score.optimality for score in self.sets):
            heads += ["of solvable %", "optimality"]
        rows = [heads, *(_cells(score)[: len(heads)] for score in self.sets)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        rows.insert(1, ["-" * widths[0], *["-" * (width - 1) + ":" for width in widths[1:]]])
        lines = [
            " | ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])])
            for row in rows
        ]
        end = f"Protocol {self.protocol}, trap-tube-jax {self.version}."
        return "\n".join([*(f"| {line} |" for line in lines), "", end])


def _cells(score: Score) -> list[str]:
    interval, found = score.interval, score.optimality
    return [
        score.label,
        str(score.tasks),
        str(score.solved),
        f"{score.percent:.1f}",
        "–" if interval is None else f"{interval[0]:.1f}–{interval[1]:.1f}",
        "–" if score.layouts is None else str(score.layouts),
        _number(score.mean_steps, ".1f"),
        _number(found and found.percent_of_solvable, ".1f"),
        _number(found and found.mean, ".3f"),
    ]


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """The 95 % score interval of a probability (Wilson, 1927).

      (p + z^2 / 2n ± z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n),  p = successes / n.

    Raises:
      ValueError: there is no trial, or not 0 <= successes <= trials.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"need 0 <= successes <= trials >= 1, got {successes} and {trials}")
    z2 = NORMAL_QUANTILE_95**2
    share = successes / trials
    center = share + z2 / (2 * trials)
    margin = math.sqrt(z2 * (share * (1 - share) / trials + z2 / (4 * trials**2)))
    scale = 1 + z2 / trials
    return max(0.0, (center - margin) / scale), min(1.0, (center + margin) / scale)
