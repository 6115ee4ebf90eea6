"""What the record of a profile comes to: percentages with intervals, and counts."""

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from agents.experiments.records import Record
from agents.experiments.statistics import Spread
from agents.profiles.mistakes import NEVER, NO_PUSH, SUBGOALS
from agents.profiles.tasks import ALL_LAYOUTS, BASE, GRADED, KINDS, SWAPS
from trap_tube_jax.scoring.scores import wilson_interval

BIN = 5  # steps, of the lengths of shortest plans
BEST, DETOUR, LOST, UNTOUCHED = "shortest way", "detour", "food lost", "tool not touched"
SOLVED = (BEST, DETOUR)
# Of an episode, from the best to the worst. A failed one is called by the last subgoal reached.
OUTCOMES = (*SOLVED, *reversed(SUBGOALS), UNTOUCHED, LOST)
PUSHES = ("right in both", "right in one", "wrong in both", "no push")
# What figures and tables show of `mistakes.Turns`.
TURNS = {
    "first_rose": "distance first rose",
    "nearest": "nearest to the goal",
    "last_fell": "distance last fell",
    "lost": "goal out of reach",
}
LABELS = {"colours 1": "{St}", ALL_LAYOUTS: "{P}", "both 1": "{P, St}"}


class Outcome(NamedTuple):
    """Play on some tasks.

    Attributes:
      tasks: how many.
      percent: of them, percent solved.
      interval: its 95 % Wilson interval; None for a single task.
      optimality: mean of shortest plan / steps taken, where solved.
    """

    tasks: int
    percent: float
    interval: tuple[float, float] | None
    optimality: Spread | None

    @classmethod
    def of(cls, steps: np.ndarray, shortest: np.ndarray) -> "Outcome":
        """That of i32[B] steps, 0 where unsolved, and the lengths of the shortest plans."""
        solved = steps > 0
        count, tasks = int(solved.sum()), len(steps)
        low, high = wilson_interval(count, tasks)
        return cls(
            tasks,
            100 * count / tasks,
            (100 * low, 100 * high) if tasks > 1 else None,
            Spread.of((shortest[solved] / steps[solved]).tolist()),
        )


def label(name: str) -> str:
    """What a point is called in tables."""
    return name.partition(", ")[2] or LABELS.get(name, name)


def outcome(record: Record, policy: Record, name: str) -> Outcome:
    """That of a policy on a point."""
    shortest = np.array(record["points"][name]["shortest"])
    return Outcome.of(np.array(policy["steps"][name]), shortest)


def on_axis(record: Record, policy: Record, axis: str) -> dict[float, Outcome]:
    """The outcomes on a graded axis by strength, from the base task on; empty if not measured."""
    named = {each["value"]: name for name, each in record["points"].items() if each["axis"] == axis}
    if axis in GRADED and named:
        named = {0.0: BASE, **named}
    return {value: outcome(record, policy, name) for value, name in named.items()}


def by_length(record: Record, policy: Record) -> dict[float, Outcome]:
    """The outcomes on {P} by the length of the shortest plan, the mean of a bin."""
    if ALL_LAYOUTS not in record["points"]:
        return {}
    shortest = np.array(record["points"][ALL_LAYOUTS]["shortest"])
    steps = np.array(policy["steps"][ALL_LAYOUTS])
    made = {}
    for start in sorted({length // BIN for length in shortest[shortest > 0].tolist()}):
        within = shortest // BIN == start
        made[float(shortest[within].mean())] = Outcome.of(steps[within], shortest[within])
    return made


def by_kind(record: Record, policy: Record) -> dict[str, Outcome]:
    """The outcomes on {P} by kind of task; see `tasks.kinds`."""
    if ALL_LAYOUTS not in record["points"]:
        return {}
    point, steps = record["points"][ALL_LAYOUTS], np.array(policy["steps"][ALL_LAYOUTS])
    shortest, known = np.array(point["shortest"]), np.array(point["kinds"])
    return {
        kind: Outcome.of(steps[known == kind], shortest[known == kind])
        for kind in KINDS
        if np.any(known == kind)
    }


def swapped(record: Record, policy: Record, whole: str = "") -> dict[str, Outcome]:
    """The outcomes by kind of symbolic swap, `tool` being none.

    Args:
      record: of the profile.
      policy: its part of it.
      whole: "both 1" for the tasks of {P, St}; empty for the base task.
    """
    names = {kind: f"{whole}, swap {kind}".removeprefix(", ") for kind in SWAPS}
    known = {kind: name for kind, name in names.items() if name in record["points"]}
    if known:
        known = {"tool": whole or BASE, **known}
    return {kind: outcome(record, policy, name) for kind, name in known.items()}


def outcomes(record: Record, policy: Record, name: str) -> dict[str, int]:
    """How many of the episodes that were looked into came to each of `OUTCOMES`."""
    limit = policy["config"]["max_steps"]
    count = record["settings"]["episodes"]
    steps, shortest = policy["steps"][name][:count], record["points"][name]["shortest"][:count]
    found = Counter(
        BEST for taken, best in zip(steps, shortest, strict=True) if taken == best <= limit
    )
    found += Counter(_called(row, steps[row["task"]]) for row in mistakes(policy, name))
    return {each: found[each] for each in OUTCOMES}


def mistakes(policy: Record, name: str) -> list[dict[str, int]]:
    """The episodes of a point that could be shorter, one by one."""
    columns = policy["mistakes"].get(name, {})
    return [
        dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)
    ]


def failed(policy: Record, name: str) -> list[dict[str, int]]:
    """Those of them that did not solve their task."""
    return [row for row in mistakes(policy, name) if not policy["steps"][name][row["task"]]]


def stage(row: Record, before: float = math.inf) -> str:
    """The last subgoal that an episode reached before a step."""
    reached = [goal for goal in SUBGOALS if row[goal] != NEVER and row[goal] < before]
    return reached[-1] if reached else UNTOUCHED


def pair_counts(record: Record, policy: Record, name: str) -> dict[str, int]:
    """How many pairs came to each of `PUSHES`; no push in one of the two counts as none."""
    first, second = (policy["pushes"][point] for point in record["pairs"][name])
    found: Counter[str] = Counter()
    for one, other, *right in zip(
        first["direction"], second["direction"], first["right"], second["right"], strict=True
    ):
        is_pushed = NO_PUSH not in (one, other)
        found[PUSHES[2 - sum(right)] if is_pushed else PUSHES[3]] += 1
    return {each: found[each] for each in PUSHES}


def _called(row: Record, steps: int) -> str:
    if steps:
        return DETOUR
    return stage(row) if row["lost"] == NEVER else LOST
