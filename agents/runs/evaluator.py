"""Greedy evaluation on the fixed tasks of the benchmark's protocol."""

from collections.abc import Sequence
from typing import Any, Self

import jax

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluation, evaluate
from agents.config import Config
from agents.networks.agent import Params
from agents.ppo import machine
from trap_tube_jax.scoring import ALL_SETS, Purpose, Suite


class Evaluator:
    """Greedy play on the tasks of several sets, compiled once for any parameters.

    Attributes:
      suite: the tasks and their step limits; scores what was played.
    """

    def __init__(self, config: Config, suite: Suite):
        """Prepares the play of tasks by policies of these settings."""
        self.suite = suite
        env = tt.Environment(base=tt.base_state(config.num_features), max_steps=suite.longest)
        agent = machine.make_agent(config)
        encoding = machine.make_encoding(agent)
        self._play: Any = jax.jit(
            lambda params, states: evaluate(agent, params, env, states, encoding)
        )

    @classmethod
    def of_sets(
        cls, config: Config, sets: Sequence[str], num_tasks: int, purpose: Purpose = "test"
    ) -> Self:
        """Builds an evaluator for registered task sets, each under its own step limit.

        Raises:
          ValueError: unknown set, or no task.
        """
        suite = Suite.of_sets(sets, num_tasks, num_features=config.num_features, purpose=purpose)
        return cls(config, suite)

    def __call__(self, params: Params) -> dict[str, Evaluation]:
        """Plays all tasks; returns NumPy arrays by the names of the sets."""
        return self.suite.play(lambda states: self._play(params, states))


def default_sets(config: Config) -> tuple[str, ...]:
    """Returns the short names of the paper's eight sets and of the training set."""
    return tuple(dict.fromkeys((*ALL_SETS, tt.task_set(config.env_id).short)))
