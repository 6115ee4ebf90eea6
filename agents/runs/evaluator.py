"""Greedy evaluation on the fixed tasks of the benchmark's protocol."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluation, evaluate
from agents.config import Config
from agents.networks.agent import Params
from agents.ppo import machine
from trap_tube_jax.scoring.benchmark import blocks, score_of
from trap_tube_jax.scoring.scores import Scores
from trap_tube_jax.scoring.tasks import ALL_SETS, PROTOCOL, Purpose, evaluation_tasks
from trap_tube_jax.state import State, take


class Evaluator:
    """Greedy play on the tasks of several sets, compiled once for any parameters."""

    def __init__(self, config: Config, tasks: Mapping[str, State]):
        """Prepares the play of each set's tasks by policies of these settings.

        If `config.max_steps` is None, the limits of the registered sets hold; ValueError names one
        that is not registered.
        """
        self.tasks = dict(tasks)
        self.limits = {name: config.step_limit(name) for name in self.tasks}
        self._ends = np.cumsum([len(states.time) for states in self.tasks.values()])
        together = jax.tree.map(lambda *parts: np.concatenate(parts), *self.tasks.values())
        self._blocks = [take(together, block) for block in blocks(int(self._ends[-1]))]
        # All sets are played up to the largest limit; a call cuts off steps beyond a set's.
        longest = max(self.limits.values())
        env = tt.Environment(base=tt.base_state(config.num_features), max_steps=longest)
        agent = machine.make_agent(config)
        encoding = machine.make_encoding(agent)
        self._play: Any = jax.jit(
            lambda params, states: evaluate(agent, params, env, states, encoding)
        )

    @classmethod
    def of_sets(
        cls, config: Config, sets: Sequence[str], num_tasks: int, purpose: Purpose = "test"
    ) -> "Evaluator":
        """Makes an evaluator of registered task sets, whose step limits hold, as in the protocol.

        Raises:
          ValueError: unknown set, or no task.
        """
        names = [tt.task_set(name).short for name in sets]
        features = config.num_features
        config = dataclasses.replace(config, max_steps=None)
        return cls(config, {x: evaluation_tasks(x, num_tasks, features, purpose) for x in names})

    def __call__(self, params: Params) -> dict[str, Evaluation]:
        """Plays all tasks; returns NumPy arrays by the names of the sets."""
        played = [jax.tree.map(np.asarray, self._play(params, states)) for states in self._blocks]
        whole = jax.tree.map(lambda *parts: np.concatenate(parts), *played)
        outcomes = {}
        for name, start, end in zip(self.tasks, [0, *self._ends], self._ends, strict=False):
            outcome, limit = take(whole, slice(start, end)), self.limits[name]
            outcomes[name] = outcome._replace(
                solved=outcome.solved & (outcome.length <= limit),
                length=np.minimum(outcome.length, limit),
            )
        return outcomes

    def scores(
        self,
        played: Mapping[str, Evaluation],
        shortest: Mapping[str, np.ndarray] | None = None,
    ) -> Scores:
        """Computes the score of every set from the outcomes that a call returned.

        `shortest` has the lengths i32[B] of each set's shortest plans, to compare with.
        """
        made = []
        for name, outcome in played.items():
            found = np.asarray(outcome.solved), np.asarray(outcome.length)
            plans = None if shortest is None else shortest[name]
            made.append(score_of(name, self.tasks[name], *found, self.limits[name], plans))
        return Scores(PROTOCOL, tt.__version__, None, tuple(made))


def own_and_paper_sets(config: Config) -> tuple[str, ...]:
    """Returns the short names of the paper's eight sets and of the training set."""
    return tuple(dict.fromkeys((*ALL_SETS, tt.task_set(config.env_id).short)))
