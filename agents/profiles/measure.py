"""Plays all points of a profile, compares the episodes with the oracle, and makes the record.

A record holds what was measured and nothing derived from it:

    schema      the name of this layout; a file of another one is refused
    command     what to type for the same profile
    settings    parts, strengths, tasks of a point, episodes looked into
    machines    hardware, versions and commit, of the profile and of the runs in it
    points      by name: axis and value, and of every task the length of its shortest plan, -1
                where there is none; of those of {P} also their kinds (see `tasks.kinds`)
    pairs       by name: the two points whose tasks differ in the trap alone, one by one
    policies    name, iteration and settings; by point the steps of every episode, 0 where it
                did not solve the task, and in pairs and controls its first push; of the first
                episodes of some points, those longer than the shortest plan, where they go wrong
                (see `mistakes`)
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from agents.acting.evaluation import Evaluation, Evaluator
from agents.acting.policy import Policy
from agents.experiments.records import Record
from agents.profiles.mistakes import SUBGOALS, Push, Turns, first_push, subgoals, turns
from agents.profiles.oracle import Oracle, replayed
from agents.profiles.tasks import ALL_LAYOUTS, BASE, PAIRS, PARTS, STRENGTHS, SWAPS, kinds, points
from agents.runs.provenance import provenance as machine
from trap_tube_jax.solver import solve_batch
from trap_tube_jax.state import State

SCHEMA = "trap-tube-jax profile 2"
# The points whose episodes are looked into, and those that are in pairs, where the parts hold them.
LOOKED_INTO = ("colours 1", ALL_LAYOUTS, "both 1", *(f"both 1, swap {name}" for name in SWAPS))
IN_PAIRS = {name for pair in PAIRS.values() for name in pair}


@dataclasses.dataclass(frozen=True)
class Settings:
    """What a profile measures.

    Attributes:
      parts: what to measure: some of colours, layout, both, swaps, controls, pairs.
      strengths: how far colours and layouts are changed: above 0, the base task, to 1, the
        paper's transfers.
      tasks: how many of every point that has more than one.
      episodes: how many of a point's episodes are searched for where they go wrong.
    """

    parts: tuple[str, ...] = PARTS
    strengths: tuple[float, ...] = STRENGTHS
    tasks: int = 200
    episodes: int = 50

    def __post_init__(self) -> None:
        """Checks the numbers; the rest is checked where tasks are drawn.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        for name, low in (("tasks", 1), ("episodes", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"{name} must be >= {low}, got {getattr(self, name)}")


def profile(
    policies: Mapping[str, Policy],
    settings: Settings,
    console: Console,
    *,
    command: str = "",
    machines: Sequence[Record] = (),
    commit: str | None = None,
) -> dict[str, Any]:
    """Measures policies and makes their record.

    Args:
      policies: by the name that figures show; all see the same number of feature channels.
      settings: what to measure.
      console: where to show how far it is.
      command: what to type for the same.
      machines: those that the policies were trained on, if known.
      commit: the commit to note where git does not tell it.

    Raises:
      ValueError: a setting is not allowed, or there is no policy, or they differ in channels.
    """
    here = machine(commit)  # first: the code may be changed while this runs
    policies = {name: _limited(policy) for name, policy in policies.items()}
    channels = {policy.config.num_features for policy in policies.values()}
    if len(channels) != 1:
        raise ValueError(
            f"give policies of one number of feature channels, got {sorted(channels) or 'none'}"
        )
    drawn = points(settings.parts, settings.strengths, settings.tasks, channels.pop())
    tasks = {name: jax.device_get(point.tasks) for name, point in drawn.items()}
    oracle = Oracle()
    columns = [*Progress.get_default_columns(), MofNCompleteColumn()]
    with Progress(*columns, console=console, transient=True) as bars:
        shortest = {
            name: solve_batch(states).length
            for name, states in bars.track(tasks.items(), description="Shortest plans")
        }
        measured = [
            _measure(name, policy, oracle, tasks, shortest, settings.episodes, bars)
            for name, policy in policies.items()
        ]
    return {
        "schema": SCHEMA,
        "command": command,
        "settings": {f.name: getattr(settings, f.name) for f in dataclasses.fields(Settings)},
        "machines": [here, *(each for each in machines if each != here)],
        "points": {
            name: {
                "axis": point.axis,
                "value": point.value,
                "shortest": shortest[name].tolist(),
                **({"kinds": kinds(tasks[name])} if name == ALL_LAYOUTS else {}),
            }
            for name, point in drawn.items()
        },
        "pairs": {name: list(pair) for name, pair in PAIRS.items() if {*pair} <= {*drawn}},
        "policies": measured,
    }


def _limited(policy: Policy) -> Policy:
    """With the step limit of the base task.

    Points are not task sets, so they have no limit of their own.
    """
    limit = policy.config.step_limit(BASE)
    return policy._replace(config=dataclasses.replace(policy.config, max_steps=limit))


class Played(NamedTuple):
    """A policy's episodes of a point; NumPy arrays.

    Attributes:
      tasks: B states at time 0.
      cells: u8[B, T + 1, 3, 2], of agent, tool and food.
      action: i32[B, T, 2].
      steps: i32[B], to the food; 0 where it was not reached.
    """

    tasks: State
    cells: np.ndarray
    action: np.ndarray
    steps: np.ndarray

    @classmethod
    def of(cls, tasks: State, outcome: Evaluation) -> "Played":
        """The episodes that an evaluation played."""
        action, steps = np.asarray(outcome.action), np.where(outcome.solved, outcome.length, 0)
        return cls(tasks, np.asarray(replayed(tasks, action)), action, steps)


def _measure(
    label: str,
    policy: Policy,
    oracle: Oracle,
    tasks: Mapping[str, State],
    shortest: Mapping[str, np.ndarray],
    episodes: int,
    bars: Progress,
) -> dict[str, Any]:
    """What the record says of a policy."""
    outcomes = Evaluator(policy.config, tasks)(policy.params)
    played = {name: Played.of(tasks[name], outcome) for name, outcome in outcomes.items()}
    pushes, mistakes = {}, {}
    for name in bars.track(tasks, description=f"{label}: where plans go wrong"):
        if name.startswith("control ") or name in IN_PAIRS:
            pushes[name] = _pushes(oracle, played[name])
        if name in LOOKED_INTO:
            mistakes[name] = _mistakes(oracle, played[name], shortest[name][:episodes])
    return {
        "name": label,
        "iteration": policy.iteration,
        "config": policy.config.to_dict(),
        "steps": {name: each.steps.tolist() for name, each in played.items()},
        "pushes": pushes,
        "mistakes": mistakes,
    }


def _pushes(oracle: Oracle, played: Played) -> dict[str, list]:
    """The first pushes of a point's episodes, as columns."""
    episodes = zip(rows(played.tasks), played.cells, strict=True)
    found = [first_push(oracle, state, cells) for state, cells in episodes]
    return {name: [getattr(push, name) for push in found] for name in Push._fields}


def _mistakes(oracle: Oracle, played: Played, shortest: np.ndarray) -> dict[str, Any]:
    """Where those of the first n episodes that took more than the shortest plan went wrong.

    Args:
      oracle: what knows the distances.
      played: the episodes.
      shortest: i32[n], the shortest plans of the first n of them.

    Returns:
      Columns, of which `task` says which episode.
    """
    names = ("task", *Turns._fields, *SUBGOALS)
    columns: dict[str, list[int]] = {name: [] for name in names}
    limit = played.action.shape[1]
    for index, state in enumerate(rows(played.tasks)[: len(shortest)]):
        steps = played.steps[index]
        if 0 < shortest[index] <= limit and steps != shortest[index]:
            length = int(steps) or limit
            cells = played.cells[index, : length + 1]
            found = turns(oracle.along(state, cells))
            reached = subgoals(state, cells, played.action[index, :length])
            for name, value in zip(names, (index, *found, *reached), strict=True):
                columns[name].append(value)
    return columns


def rows(states: State) -> list[State]:
    """The states of a batch."""
    return [jax.tree.map(lambda x, i=i: np.asarray(x)[i], states) for i in range(len(states.time))]
