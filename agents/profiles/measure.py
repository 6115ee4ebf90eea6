"""Greedy play on the tasks of a profile, as a tidy table, and smaller tables made from it."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import numpy as np
import pandas as pd

from agents.acting.policy import Policy
from agents.profiles.subgoals import SUBGOALS, last_subgoals
from agents.profiles.tasks import PARTS, STRENGTHS, Part, Sampling
from agents.runs.evaluator import Evaluator
from trap_tube_jax.objects import MAX_STEPS
from trap_tube_jax.scoring import Suite
from trap_tube_jax.solver import solve_batch

BIN = 5  # steps, the width of the groups by plan length
FAILED = [f"failed: {name}" for name in SUBGOALS]
AGGREGATES = (
    dict.fromkeys(("tasks", "solved"), "sum")
    | dict.fromkeys(("steps", "plan", "optimality"), "mean")
    | dict.fromkeys(FAILED, "sum")
)


def profile(
    policies: Mapping[str, Policy],
    parts: Sequence[str] = tuple(PARTS),
    strengths: Sequence[float] = STRENGTHS,
    num_tasks: int = 200,
) -> pd.DataFrame:
    """Plays each task of a profile once with each policy, greedily.

    Args:
      policies: policies by display name, all with the same number of feature channels.
      parts: names of `tasks.PARTS`.
      strengths: of the graded transfers, from 0 (the base task) to 1 (the paper's transfer).
      num_tasks: tasks of each strength and symbolic swap, and of the other draws from {P}.

    Returns:
      One row per policy, part and level. Columns: the number of tasks and of solved tasks; mean
      steps and mean optimality (shortest plan / steps) of the solved tasks; mean length of the
      shortest plan of the solvable tasks; and, for each of `FAILED`, the number of failed episodes
      that reached this subgoal last.

    Raises:
      ValueError: a setting is not allowed, or the policies differ in feature channels.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown or not parts:
        raise ValueError(f"unknown parts {unknown}; allowed: one or more of {', '.join(PARTS)}")
    channels = {policy.config.num_features for policy in policies.values()}
    if len(channels) != 1:
        raise ValueError(f"profile policies of one num_features together, got {sorted(channels)}")
    sampling = Sampling(strengths, num_tasks, channels.pop())
    drawn = {part: PARTS[part](sampling) for part in parts}
    # One call, since parts share tasks and each task is solved once.
    together = jax.tree.map(lambda *x: np.concatenate(x), *(part.tasks for part in drawn.values()))
    ends = np.cumsum([len(part.tasks.time) for part in drawn.values()])
    plans = dict(zip(drawn, np.split(solve_batch(together).length, ends[:-1]), strict=True))
    episodes = pd.concat([_play(name, policy, drawn, plans) for name, policy in policies.items()])
    groups = episodes.groupby(["policy", "part", "level"], sort=False)
    return pd.DataFrame(groups.agg(AGGREGATES)).reset_index()


def success_table(profile: pd.DataFrame) -> pd.DataFrame:
    """Returns the percentage of tasks solved, a row for each part and level."""
    shares = profile.assign(percent=100 * profile["solved"] / profile["tasks"])
    index = ["part", "level", "tasks"]
    return shares.pivot_table("percent", index, "policy", sort=False).round(1)


def failure_table(profile: pd.DataFrame) -> pd.DataFrame:
    """Returns the number of failed episodes of each part, by the last subgoal reached."""
    table = profile.pivot_table(FAILED, ["policy", "part"], aggfunc="sum", sort=False)
    return table.set_axis(list(SUBGOALS), axis="columns")


def _play(
    name: str, policy: Policy, parts: Mapping[str, Part], plans: Mapping[str, np.ndarray]
) -> pd.DataFrame:
    """Plays all parts with a policy; returns a row for each episode."""
    config = dataclasses.replace(policy.config, max_steps=MAX_STEPS)
    tasks = {part: drawn.tasks for part, drawn in parts.items()}
    evaluator = Evaluator(config, Suite(tasks, dict.fromkeys(tasks, MAX_STEPS)))
    frames = []
    for part, played in evaluator(policy.params).items():
        tasks, levels = parts[part]
        solved, plan = np.asarray(played.solved), plans[part]
        steps = np.where(solved, played.length, np.nan)
        subgoals = last_subgoals(tasks, np.asarray(played.action))
        starts = plan // BIN * BIN
        frame = pd.DataFrame(
            {
                "policy": name,
                "part": part,
                "level": levels or [f"{start}-{start + BIN - 1}" for start in starts],
                "tasks": 1,
                "solved": solved,
                "steps": steps,
                "plan": np.where(plan >= 0, plan, np.nan),
                "optimality": plan / steps,
                **{column: ~solved & (subgoals == i) for i, column in enumerate(FAILED)},
            }
        )
        frames.append(frame if levels else frame.sort_values("plan"))
    return pd.concat(frames)
