"""Agents that learn the trap-tube task: PPO with curiosity, end-to-end jitted."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from agents.acting.policy import Policy
from agents.config import Config
from agents.ppo.learner import Learner, TrainState, make_train

__all__ = ["Config", "Learner", "Policy", "TrainState", "load", "make_train", "results"]


def load(
    source: str | Path,
    *,
    seed: int | None = None,
    iteration: int | None = None,
    greedy: bool = True,
) -> Policy:
    """A trained policy, which acts from observations alone.

        policy = load("runs/mine")
        carry = policy.initial(batch)
        action, carry = policy.act(observation, carry, key)

    Args:
      source: a run's folder, a file of parameters, or the name of shipped parameters.
      seed: which seed of a run; its first if absent.
      iteration: the checkpoint of a run to take; the newest if absent.
      greedy: take the most probable actions; false draws them.

    Raises:
      ValueError: there is no such policy, or it cannot be read.
    """
    from agents.runs import loading  # noqa: PLC0415  training needs nothing of files

    return loading.load_policy(source, seed, iteration)._replace(greedy=greedy)


def results(paths: str | Path | Iterable[str | Path]) -> list[dict[str, Any]]:
    """One plain record per seed of all runs in folders; see `agents.runs.results.results`."""
    from agents.runs import results  # noqa: PLC0415  training needs nothing of files

    return results.results(paths)
