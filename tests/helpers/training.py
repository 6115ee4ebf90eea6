"""Small runs in this process, of true or scripted training."""

import functools

import jax
import jax.numpy as jnp

from agents.acting.evaluation import Evaluation
from agents.ppo.learner import Learner
from agents.runs import program
from agents.runs.run import Run, RunOptions
from helpers.small_runs import small_config

ITERATIONS = 6
TRACKED = RunOptions(
    checkpoint_every=3, evaluate_every=2, sets=("base", "p"), test_tasks=3, report=False
)
PLAIN = RunOptions(checkpoint_every=2, sets=("base",), report=False)


def small_run(iterations=ITERATIONS, **values):
    replay = {"replay_fractions": (0.25, 0.25), "replay_capacity": 5}
    return Run(small_config(iterations=iterations, motion_coef=0.5, **replay), **values)


def replace_training(monkeypatch, change, evaluate=None):
    """Makes an iteration count and set its metrics to 0, then `change` what it returns.

    Validation tasks are played by `evaluate`, or not solved.
    """
    iterate = Learner.iterate

    def count(self, state):
        _, metrics = jax.eval_shape(functools.partial(iterate, self), state)
        metrics = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metrics)
        return change(state._replace(iteration=state.iteration + 1), metrics)

    def fail(*_):
        return outcome(jnp.array([False]))

    monkeypatch.setattr(Learner, "iterate", count)
    monkeypatch.setattr(program, "evaluate", evaluate or fail)


def outcome(solved):
    return Evaluation(solved, *jnp.ones((3, len(solved))))


def count_up(state, metrics):
    """Adds 1 to all parameters."""
    return state._replace(params=jax.tree.map(lambda x: x + 1, state.params)), metrics
