"""Greedy evaluation on several task sets as training goes, and the best parameters."""

import itertools
from collections.abc import Sequence

import numpy as np

from agents.acting.evaluation import Evaluator
from agents.acting.policy import Policy
from agents.acting.policy_files import save_policy
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import Row
from trap_tube_jax.registry import task_set
from trap_tube_jax.scoring.scores import Score
from trap_tube_jax.scoring.tasks import Purpose


class PeriodicEvaluator:
    """Evaluates the seeds of a run as training goes and keeps the best parameters.

    Parameters are the best if they solve the highest mean fraction of the validation tasks over
    all sets; base, a single task, counts only where it is trained on.
    """

    def __init__(self, folder: RunFolder, run: Run, sets: Sequence[str], rows: Sequence[Row]):
        """Draws the tasks of sets, and continues after earlier rows of `evaluations.csv`."""
        self._folder = folder
        trained_on_base = task_set(run.config.env_id).short == "base"
        self._ranked = [name for name in sets if name != "base" or trained_on_base] or list(sets)
        tasks = run.config.eval_episodes
        self._evaluator = Evaluator.of_sets(run.config, sets, tasks, "validation")
        self._best: dict[int, float] = {}
        evaluated = itertools.groupby(
            (row for row in rows if row["purpose"] == "validation"),
            lambda row: (row["seed"], row["iteration"]),
        )
        for (seed, _), group in evaluated:
            self._is_best(seed, list(group))

    def evaluate(self, seed: int, policy: Policy) -> list[Row]:
        """Plays with the policy of one seed; returns its rows of `evaluations.csv`."""
        scores = self._evaluator.scores(self._evaluator(policy.params))
        rows = evaluation_rows(scores, policy, seed, "validation")
        if self._is_best(seed, rows):
            save_policy(self._folder.best(seed), policy)
        return rows

    def _is_best(self, seed: int, rows: Sequence[Row]) -> bool:
        """Returns whether an evaluation is a seed's best so far, and remembers it."""
        shares = [row["solved"] / row["tasks"] for row in rows if row["task_set"] in self._ranked]
        mean, before = float(np.mean(shares)), self._best.get(seed, -1.0)
        self._best[seed] = max(mean, before)
        return mean > before


def evaluation_rows(
    scores: Sequence[Score], policy: Policy, seed: int, purpose: Purpose
) -> list[Row]:
    """Returns a row of `evaluations.csv` for each score of a policy.

    `solved` counts tasks. Where a set has few layouts, `layouts` of `layouts_total` are solved in
    more than half of their draws. `length` is the mean number of steps of solved episodes.
    """
    return [
        {
            "seed": seed,
            "iteration": policy.iteration,
            "purpose": purpose,
            "task_set": score.set,
            "tasks": score.tasks,
            "solved": score.solved,
            "layouts": score.layouts.solved if score.layouts else "",
            "layouts_total": score.layouts.total if score.layouts else "",
            "length": "" if score.mean_steps is None else round(score.mean_steps, 4),
        }
        for score in scores
    ]
