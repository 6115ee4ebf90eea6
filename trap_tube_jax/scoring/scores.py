"""Scores of play on fixed tasks: the share solved, its interval, and optimality.

Source: protocol.md, "Reporting".
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from trap_tube_jax.registry import task_set
from trap_tube_jax.tables import markdown_table


@dataclasses.dataclass(frozen=True)
class Optimality:
    """A comparison of solved episodes with shortest plans.

    Attributes:
      solvable: number of tasks that some plan within the step limit solves.
      percent_of_solvable: percent of the solvable tasks that are solved; None without any.
      mean: mean of shortest length / steps taken over solved tasks; None without any.
    """

    solvable: int
    percent_of_solvable: float | None
    mean: float | None

    @classmethod
    def of(
        cls, solved: np.ndarray, length: np.ndarray, shortest: np.ndarray, max_steps: int
    ) -> "Optimality":
        """Compares outcomes bool[B] and lengths i32[B] with shortest plans i32[B], -1 for none."""
        solvable = (shortest >= 0) & (shortest <= max_steps)
        ratio = shortest[solved] / length[solved]
        return cls(
            solvable=int(solvable.sum()),
            percent_of_solvable=100 * float(solved[solvable].mean()) if solvable.any() else None,
            mean=float(ratio.mean()) if len(ratio) else None,
        )


@dataclasses.dataclass(frozen=True)
class Layouts:
    """Success by layout, colours aside, in a set of few layouts.

    Attributes:
      solved: number of layouts that are solved in more than half of their draws.
      total: number of layouts among the draws.
    """

    solved: int
    total: int

    @classmethod
    def of(cls, solved: np.ndarray, layout: np.ndarray) -> "Layouts":
        """Counts the layouts i32[B] of outcomes bool[B]."""
        shares = [float(np.mean(solved[layout == number])) for number in np.unique(layout)]
        return cls(sum(share > 0.5 for share in shares), len(shares))

    def __str__(self) -> str:
        return f"{self.solved} of {self.total}"


@dataclasses.dataclass(frozen=True)
class Score:
    """The score on the fixed tasks of one set.

    Attributes:
      set: the set's short name.
      label: the set's name in the paper's notation.
      tasks: number of tasks played.
      solved: number of tasks solved.
      percent: 100 solved / tasks.
      interval: 95 % Wilson interval of the percentage over the set's tasks; None where the
        set has few layouts, so that its draws are no sample of many tasks.
      mean_steps: mean steps of the solved episodes; None without any.
      layouts: the layouts solved; None unless the set has few.
      optimality: the comparison with shortest plans; None unless requested.

    Example:
      >>> class Still:
      ...     act = lambda self, observation: (0, 0)
      >>> score = tt.score_gymnasium(Still(), sets=("sy",), tasks=10)["sy"]
      >>> score.label, score.tasks, score.solved
      ('{Sy}', 10, 0)
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
        """Computes the score of outcomes bool[B] and numbers of steps i32[B].

        `layout` i32[B] numbers the layouts of the tasks; it is None unless the set has few.
        """
        count = int(np.sum(solved))
        tasks = len(solved)
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
class Scores(Mapping[str, Score]):
    """The scores of an agent by the benchmark's protocol; a Markdown table in ASCII if printed.

    A mapping from short names of sets to their scores, which also takes the sets' other names.

    Attributes:
      protocol: version of the fixed tasks.
      version: version of this package.
      seed: seed of the agent's actions; None for an agent in plain Python.
      sets: the score of every set.

    Example:
      >>> class Still:
      ...     act = lambda self, observation: (0, 0)
      >>> scores = tt.score_gymnasium(Still(), sets=("base", "sy"), tasks=10)
      >>> {name: scores[name].percent for name in scores}
      {'base': 0.0, 'sy': 0.0}
    """

    protocol: int
    version: str
    seed: int | None
    sets: tuple[Score, ...]

    def __getitem__(self, name: str) -> Score:
        """Returns the score of a set by any of its names, or raises KeyError."""
        try:
            short = task_set(name).short
        except ValueError:  # the set is not registered here
            short = name
        for score in self.sets:
            if score.set == short:
                return score
        raise KeyError(f"no score of {name!r}; allowed: {', '.join(self)}")

    def __iter__(self) -> Iterator[str]:
        """Iterates over the short names of the sets."""
        return (score.set for score in self.sets)

    def __len__(self) -> int:
        return len(self.sets)

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON; `sets` is a sequence of records."""
        return dataclasses.asdict(self)

    def __str__(self) -> str:
        heads = ["set", "tasks", "solved", "%", "95 % interval", "layouts", "steps"]
        parts = [markdown_table([heads, *map(_cells, self.sets)])]
        compared = [score for score in self.sets if score.optimality]
        if compared:  # a table of its own, since lines of both would not fit a terminal
            heads = ["set", "% of solvable", "shortest plan / steps"]
            parts.append(markdown_table([heads, *map(_optimality_cells, compared)]))
        end = f"Protocol {self.protocol}, trap-tube-jax {self.version}."
        if any(score.layouts for score in self.sets):
            end = f"A layout counts as solved if more than half of its draws are solved.\n{end}"
        return "\n\n".join([*parts, end])


def _cells(score: Score) -> list[str]:
    interval = score.interval
    return [
        score.label,
        str(score.tasks),
        str(score.solved),
        f"{score.percent:.1f}",
        "-" if interval is None else f"{interval[0]:.1f}-{interval[1]:.1f}",
        "-" if score.layouts is None else str(score.layouts),
        _number(score.mean_steps, ".1f"),
    ]


def _optimality_cells(score: Score) -> list[str]:
    found = score.optimality
    return [
        score.label,
        _number(found and found.percent_of_solvable, ".1f"),
        _number(found and found.mean, ".3f"),
    ]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Returns the 95 % score interval of a probability (Wilson, 1927); `trials` is at least 1."""
    from scipy.stats import binomtest  # noqa: PLC0415  importing the environment must stay light

    low, high = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return float(low), float(high)
