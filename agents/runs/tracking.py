"""Greedy play on several task sets as training goes, and the best parameters."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from agents.acting.evaluation import Evaluator
from agents.acting.policy import Policy
from agents.acting.policy_files import save_policy
from agents.ppo.learner import GREEDY
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import Row
from trap_tube_jax.state import State

OVERALL = f"{GREEDY}overall"


class Tracker:
    """Evaluates the seeds of a run on task sets, every so many iterations.

    Each evaluation adds to the metrics the share of tasks solved of every set, `greedy_<set>`,
    and their mean over the ranked sets, `greedy_overall`; in between these are NaN. The run's
    `best-seed<seed>-iteration<iteration>.safetensors` gets the parameters of the best evaluation so far.
    Those of the best until a checkpoint stay at least until the next one, so that a run that is
    killed and continues from there finds them.
    """

    def __init__(
        self,
        folder: RunFolder,
        run: Run,
        tasks: Mapping[str, State],
        *,
        ranked: Sequence[str],
        every: int = 1,
    ):
        """Prepares the evaluation.

        Args:
          folder: the run's files.
          run: what is trained.
          tasks: the tasks of each set, by name.
          ranked: the sets that decide which evaluation is the best.
          every: iterations from one evaluation to the next; an iteration that solves the
            training set for the first time is evaluated in any case.
        """
        self._folder = folder
        self._ranked, self._every = tuple(ranked), every
        self._evaluator = Evaluator(run.config, tasks)
        self._best = dict.fromkeys(run.seed_range, -math.inf)

    def resume(self, rows: Sequence[Row], iteration: int) -> None:
        """Continues after these rows of metrics, the last of which is of `iteration`."""
        for seed in self._best:
            for done, path in self._folder.kept_best(seed).items():
                if done > iteration:
                    path.unlink()
        for row in rows:
            seed, overall = int(row["seed"]), float(row.get(OVERALL, math.nan))
            self._best[seed] = max(self._best[seed], overall)

    def is_due(self, iteration: int) -> bool:
        """Whether this iteration is among those that are evaluated regularly."""
        return iteration % self._every == 0

    def forget(self, iteration: int) -> None:
        """Deletes parameters that were no longer the best at this iteration."""
        for seed in self._best:
            before = [
                path for done, path in self._folder.kept_best(seed).items() if done <= iteration
            ]
            for path in before[:-1]:
                path.unlink()

    def skip(self) -> dict[str, float]:
        """The columns of an iteration without evaluation."""
        return {**{GREEDY + name: math.nan for name in self._evaluator.tasks}, OVERALL: math.nan}

    def evaluate(self, seed: int, policy: Policy) -> dict[str, float]:
        """Plays with the policy of one seed and returns the columns of its row."""
        played = self._evaluator(policy.params)
        shares = {name: float(np.mean(outcome.solved)) for name, outcome in played.items()}
        overall = float(np.mean([shares[name] for name in self._ranked]))
        if overall > self._best[seed]:
            self._best[seed] = overall
            save_policy(self._folder.best(seed, policy.iteration), policy)
        return {**{GREEDY + name: share for name, share in shares.items()}, OVERALL: overall}
