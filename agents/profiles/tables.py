"""The tables of a profile, from its record."""

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from agents.experiments.records import Record
from agents.experiments.tables import provenance
from agents.profiles import summary
from agents.profiles.mistakes import NEVER, NO_PUSH, SUBGOALS
from agents.profiles.summary import OUTCOMES, PUSHES, SOLVED, TURNS, UNTOUCHED, Outcome
from agents.profiles.tasks import BASE
from agents.runs.table import NOTHING, Table
from trap_tube_jax.objects import DIRECTION_NAMES

AXES = {
    "colours": "Colours: strength of the structural transfer; the mean angle is 90° times it",
    "layout": "Layout: strength of the perceptual transfer",
    "both": "Layout and colours: strength of both transfers",
}
STANDING = "no step back, some without effect"
CELLS = "solved % [95 % Wilson interval], and mean of shortest plan / steps where solved"


def tables(record: Record) -> list[Table]:
    """All tables of a profile, as far as its parts go."""
    made = [
        _outcomes(record, f"{title}; {CELLS}", "strength", _on_axis(axis))
        for axis, title in AXES.items()
    ]
    made.append(
        _outcomes(record, f"{{P}} by length of the shortest plan; {CELLS}", "steps", _by_length)
    )
    heading = f"{{P}} by the way of the food, seen from the agent, and how the tool lies; {CELLS}"
    made.append(_outcomes(record, heading, "kind", summary.by_kind))
    for whole, title in (("", "Base task"), ("both 1", "{P, St}")):
        heading = f"{title} by what the tool swaps its looks with, tool being no swap; {CELLS}"
        made.append(_outcomes(record, heading, "swap", partial(summary.swapped, whole=whole)))
    made += [controls_table(record), pairs_table(record)]
    made += [mistakes_table(record, policy) for policy in record["policies"]]
    return [table for table in made if table.rows]


def markdown(record: Record) -> str:
    """All tables and the provenance in Markdown."""
    parts = [f"**{table.title}**\n\n{table.to_markdown()}" for table in tables(record)]
    return "\n\n".join([*parts, f"`{record['command']}`", *provenance(record)])


def controls_table(record: Record) -> Table:
    """The controls in base colours: steps taken, and the first push."""
    names = [name for name, point in record["points"].items() if point["axis"] == "control"]
    rows = []
    for name in [BASE, *names] if names else ():
        best = record["points"][name]["shortest"][0]
        cells = [_played(policy, name) for policy in record["policies"]]
        rows.append((name.removeprefix("control "), str(best) if best > 0 else "none", *cells))
    title = (
        "Controls, in base colours: steps, and the first push; ✓ where it brought the goal nearer"
    )
    return Table(title, _heads(record, "task", "shortest"), tuple(rows))


def pairs_table(record: Record) -> Table:
    """The paired test: does the first push go the right way in both tasks?"""
    rows = []
    for name in record["pairs"]:
        for policy in record["policies"]:
            counts = summary.pair_counts(record, policy, name)
            total = sum(counts.values())
            cells = (f"{100 * count / total:.1f}" for count in counts.values())
            rows.append((name, policy["name"], str(total), *cells))
    title = "First push in pairs of tasks that differ in the trap alone, % of pairs"
    return Table(title, ("pair", "agent", "number", *PUSHES), tuple(rows))


def mistakes_table(record: Record, policy: Record) -> Table:
    """What a policy fails at: a column for each point."""
    names = list(policy["mistakes"])
    counts = [summary.outcomes(record, policy, name) for name in names]
    failed = [summary.failed(policy, name) for name in names]
    detours = [
        [row for row in summary.mistakes(policy, name) if policy["steps"][name][row["task"]]]
        for name in names
    ]
    rows = [
        (each if each in SOLVED else f"failed: {each}", *(str(count[each]) for count in counts))
        for each in OUTCOMES
    ]
    rows += [
        (
            f"failed ones, {text}: median step",
            *(_median([row[turn] for row in each]) for each in failed),
        )
        for turn, text in TURNS.items()
    ]
    rows += [
        (
            f"detours, {goal}: median step",
            *(_median([row[goal] for row in each]) for each in detours),
        )
        for goal in SUBGOALS
    ]
    begins = [Counter(map(_begin, each)) for each in detours]
    rows += [
        (f"detours, begun after: {stage}", *(str(each[stage]) for each in begins))
        for stage in (UNTOUCHED, *SUBGOALS, STANDING)
    ]
    title = (
        f"What {policy['name']} fails at, in the first episodes of each set. Failed ones are called"
        " by the last subgoal that they reached"
    )
    heads = ("episodes", *map(summary.label, names))
    return Table(title, heads, tuple(rows) if names else ())


def _begin(row: Record) -> str:
    """The last subgoal that a detour reached before it first took the goal farther away."""
    return STANDING if row["first_rose"] == NEVER else summary.stage(row, row["first_rose"])


def _median(steps: list[int]) -> str:
    known = [step for step in steps if step != NEVER]
    return f"{np.median(known):.0f}" if known else NOTHING


Find = Callable[[Record, Record], Mapping[str, Outcome]]


def _on_axis(axis: str) -> Find:
    return lambda record, policy: {
        f"{value:g}": each for value, each in summary.on_axis(record, policy, axis).items()
    }


def _by_length(record: Record, policy: Record) -> dict[str, Outcome]:
    found = summary.by_length(record, policy)
    starts = (int(mean // summary.BIN) * summary.BIN for mean in found)
    return {
        f"{start}–{start + summary.BIN - 1}": each
        for start, each in zip(starts, found.values(), strict=True)
    }


def _outcomes(record: Record, title: str, first: str, find: Find) -> Table:
    """A table of outcomes: a column for each policy."""
    found = [find(record, policy) for policy in record["policies"]]
    rows = tuple(
        (row, str(each.tasks), *(_cell(column[row]) for column in found))
        for row, each in found[0].items()
    )
    return Table(title, _heads(record, first, "tasks"), rows)


def _heads(record: Record, *first: str) -> tuple[str, ...]:
    return (*first, *(policy["name"] for policy in record["policies"]))


def _cell(outcome: Outcome) -> str:
    text = f"{outcome.percent:.1f}"
    if outcome.interval is not None:
        text += " [{:.1f}, {:.1f}]".format(*outcome.interval)
    return text + ("" if outcome.optimality is None else f"; {outcome.optimality.mean:.2f}")


def _played(policy: Record, name: str) -> str:
    steps = policy["steps"][name][0]
    direction = policy["pushes"][name]["direction"][0]
    push = "no push"
    if direction != NO_PUSH:
        push = f"{DIRECTION_NAMES[direction]} {'✓' if policy['pushes'][name]['right'][0] else '✗'}"
    return f"{steps or 'failed'}; {push}"
