"""Greedy play on the tasks of a profile, as a tidy table, and smaller tables made from it."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import pandas as pd

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluation
from agents.acting.policy import Policy
from agents.profiles.tasks import FIRST_TRIES, PARTS, STRENGTHS, Part, Sampling
from agents.runs.evaluator import Evaluator
from agents.runs.metrics import Table
from trap_tube_jax import dynamics
from trap_tube_jax.checks import MAX_TASKS, check_integer
from trap_tube_jax.objects import MAX_STEPS
from trap_tube_jax.scoring import Suite
from trap_tube_jax.scoring.knowledge import choice_of_exit, first_grasp, first_push
from trap_tube_jax.scoring.scores import wilson_interval
from trap_tube_jax.state import concatenate_trees

LONG = 100  # steps, twice the paper's limit
COUNTS = ["tasks", "solved", "solved_100", "direct", "choices", "right"]
MEANS = ["steps", "plan", "optimality"]

_first_push = jax.jit(jax.vmap(first_push))
_choice_of_exit = jax.jit(jax.vmap(choice_of_exit))
_first_grasp = jax.jit(jax.vmap(first_grasp))


def profile(
    policies: Mapping[str, Policy],
    parts: Sequence[str] = tuple(PARTS),
    strengths: Sequence[float] = STRENGTHS,
    num_tasks: int = 200,
    report: Callable[[str], None] = lambda _: None,
) -> Table:
    """Plays the tasks of a profile once with each policy, greedily.

    Args:
      policies: policies by display name, all with the same number of feature channels.
      parts: names of `tasks.PARTS`.
      strengths: of the graded transfers, from 0 (the base task) to 1 (the paper's transfer).
      num_tasks: tasks of each strength and symbolic swap, and of the other sets drawn.
      report: called with one line before each stage.

    Returns:
      One row per policy, part and level. Columns: the number of tasks, of tasks solved within 50
      and within 100 steps (`solved`, `solved_100`), and of controls solved directly (`direct`, see
      `episodes`); the number of first pushes that chose between exit and trap, and of right ones
      (`choices`, `right`); mean steps and mean optimality (shortest plan / steps) of the tasks
      solved within 50; and mean length of the shortest plan of the solvable tasks.

    Raises:
      ValueError: a setting is not allowed, or the policies differ in feature channels.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown or not parts:
        raise ValueError(f"unknown parts {unknown}; allowed: one or more of {', '.join(PARTS)}")
    check_integer("tasks", num_tasks, maximum=MAX_TASKS)
    if not strengths:
        raise ValueError(f"no strengths; allowed: one or more from 0 to 1, as in {STRENGTHS}")
    channels = {policy.config.num_features for policy in policies.values()}
    if len(channels) != 1:
        raise ValueError(f"profile policies of one num_features together, got {sorted(channels)}")
    sampling = Sampling(strengths, num_tasks, channels.pop())
    report("Drawing tasks")
    drawn = {part: PARTS[part](sampling) for part in parts}
    count = sum(len(part.tasks.time) for part in drawn.values())
    report(f"Searching for the shortest plans of {count:,} tasks, up to a minute per 1,000")
    states = concatenate_trees(part.tasks for part in drawn.values())
    plans = tt.solve_batch(states)
    played = []
    for name, policy in policies.items():
        report(f"Playing {count:,} tasks with {name}, a minute or two")
        played.append(_play(policy, drawn, states, plans).assign(policy=name))
    groups: Any = pd.concat(played).groupby(["policy", "part", "level"], sort=False)
    counts = groups[COUNTS].sum(min_count=1)  # a sum without numbers is unknown, not 0
    return counts.join(groups[MEANS].mean()).reset_index()


def episodes(tasks: tt.State, played: Evaluation, plan: tt.Plan) -> Table:
    """Describes B episodes of at most 100 steps, a row per episode.

    An episode counts up to its 50th step; the column `solved_100` alone tells what comes later.
    `choice` is the `choice_of_exit` of the first push, `grasp` the `first_grasp`. `direct` holds if
    the task is solved and every push of the food has the direction in which a shortest plan pushes
    it first. Where this plan pushes nothing, the tool must stay in its initial cell, too.
    """
    solved_100 = np.asarray(played.solved)
    solved = solved_100 & (np.asarray(played.length) <= MAX_STEPS)
    actions = np.asarray(played.action)[:, :MAX_STEPS]
    tool, food = map(np.asarray, _paths(tasks, actions))
    planned = np.asarray(_first_push(tasks, plan.actions))
    steps = np.where(solved, played.length, np.nan)
    choice = _choice_of_exit(tasks, _first_push(tasks, actions))
    found = {
        "tasks": 1,
        "solved": solved,
        "solved_100": solved_100,
        "direct": (solved & is_direct(tool, food, planned)).astype(float),
        "choice": choice,
        "choices": choice != 0,
        "right": choice == 1,
        "grasp": _first_grasp(tasks, actions),
        "steps": steps,
        "plan": np.where(plan.solvable, plan.length, np.nan),
        "optimality": plan.length / steps,
    }
    return pd.DataFrame(found)


def success_table(profile: Table) -> Table:
    """Returns the percentages of tasks solved, a row for each part and level.

    Has two columns per policy: within 50 steps, with a 95 % interval, and within 100 steps.
    """
    rows = profile[~profile["part"].isin(FIRST_TRIES)]
    within_50 = [percent(*row) for row in zip(rows["solved"], rows["tasks"], strict=True)]
    within_100 = [f"{share:.1f}" for share in 100 * rows["solved_100"] / rows["tasks"]]
    rows = rows.assign(**{"50 steps": within_50, "100 steps": within_100})
    index = ["part", "level", "tasks"]
    table = rows.pivot(index=index, columns="policy", values=["50 steps", "100 steps"])
    table = table.swaplevel(axis="columns").reindex(rows["policy"].unique(), level=0, axis=1)
    return table.loc[pd.MultiIndex.from_frame(rows[index].drop_duplicates())]


def control_table(profile: Table) -> Table:
    """Returns the percentages of controls solved directly, with 95 % intervals."""
    rows = profile[profile["part"] == "control"]
    shown = [percent(*row) for row in zip(rows["direct"], rows["tasks"], strict=True)]
    table = rows.assign(shown=shown).pivot(index="level", columns="policy", values="shown")
    return table.loc[rows["level"].unique(), rows["policy"].unique()]


def knowledge_table(profile: Table) -> Table:
    """Returns the accuracy of first pushes and first grasps, a row for each policy and part.

    Counts the episodes whose first push is a choice between the exit and the other way, or that
    have a first grasp. Their success within 50 steps stands beside it, after right and wrong ones.
    """
    rows = profile[profile["part"].isin(FIRST_TRIES)]
    found = {}
    for (policy, part), groups in rows.groupby(["policy", "part"], sort=False):
        levels = FIRST_TRIES[part]
        counts = groups.set_index("level")[["tasks", "solved"]]
        counts = counts.reindex([levels[1], levels[-1]], fill_value=0)
        (right, right_solved), (wrong, wrong_solved) = counts.to_numpy()
        found[policy, part] = {
            "tries": f"{right + wrong:.0f}",
            "right, %": percent(right, right + wrong),
            "then solved, %": percent(right_solved, right),
            "else solved, %": percent(wrong_solved, wrong),
        }
    return pd.DataFrame(found).T.rename_axis(["policy", "part"])


def percent(successes: float, trials: float) -> str:
    """Formats a percentage with its 95 % Wilson interval; a single trial has no interval."""
    if trials < 2:
        return f"{100 * successes / trials:.0f}" if trials else "-"
    low, high = wilson_interval(int(successes), int(trials))
    return f"{100 * successes / trials:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def is_direct(tool: np.ndarray, food: np.ndarray, planned: np.ndarray) -> np.ndarray:
    """Tests whether B episodes push the food only in the direction `planned` i32[B, 2], bool[B].

    Where it is zero, the tool must not move either. Takes the results of `_paths`.
    """
    push = np.diff(food, axis=1)
    has_direction = np.all(push == planned[:, None], axis=-1) | ~np.any(push, axis=-1)
    is_needed = np.any(planned, axis=1)
    tool_moves = np.any(tool != tool[:, :1], axis=(1, 2))
    return np.all(has_direction, axis=1) & (is_needed | ~tool_moves)


@jax.jit
@jax.vmap
def _paths(task: tt.State, actions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the cells of tool and food in an episode, i32[T + 1, 2] each."""
    states = dynamics.replay(task, actions)
    return states.tool, states.food


def _play(policy: Policy, parts: Mapping[str, Part], states: tt.State, plans: tt.Plan) -> Table:
    """Plays all parts with a policy; returns a row for each episode, level by level.

    `states` and `plans` are of the tasks of all parts, one after the other.
    """
    suite = Suite({name: part.tasks for name, part in parts.items()}, dict.fromkeys(parts, LONG))
    played = Evaluator(policy.config, suite)(policy.params)
    together = episodes(states, concatenate_trees(played.values()), plans)
    counts = [len(part.tasks.time) for part in parts.values()]
    tables = []
    for name, rows in together.groupby(np.repeat(list(parts), counts), sort=False):
        levels = parts[str(name)].levels
        table = rows.assign(part=name, direct=rows["direct"] if name == "control" else np.nan)
        if callable(levels):
            table = table.assign(level=levels(table)).sort_values("level", kind="stable")
            table = table.astype({"level": str})
        else:
            table = table.assign(level=levels)
        tables.append(table)
    return pd.concat(tables)
