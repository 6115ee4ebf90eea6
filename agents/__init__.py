"""Agents that learn the trap-tube task: PPO with curiosity, jitted end to end."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from agents.acting.policy import Policy
from agents.config import Config
from agents.ppo.learner import Learner, TrainState, make_train

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Config", "Learner", "Policy", "TrainState", "load", "make_train", "results", "save"]


def load(
    source: str | Path,
    *,
    iteration: int | None = None,
    greedy: bool = True,
    imports: tuple[str, ...] = (),
) -> Policy:
    """Loads a trained policy, which acts from observations alone.

        policy = load("best-pstsy")
        carry = policy.initial(batch)
        action, carry = policy.act(observation, carry, key)

    Reading runs no code that the source names; only `imports` are imported.

    Args:
      source: a run's folder, a file of parameters, or the name of a shipped agent.
      iteration: checkpoint of a run; if None, the best policy of a run that selects one
        (`--evaluate-every`), else the newest checkpoint.
      greedy: take the most probable actions; False samples them.
      imports: modules to import first, which register curiosities, encoders or task sets.

    Raises:
      ValueError: there is no such policy, or it cannot be read.
    """
    from agents.runs import loading  # noqa: PLC0415  training needs no files

    return loading.load_policy(source, iteration, imports)._replace(greedy=greedy)


def save(path: str | Path, policy: Policy) -> None:
    """Saves a policy to one safetensors file, which `load` reads."""
    from agents.runs import loading  # noqa: PLC0415  training needs no files

    loading.save_policy(Path(path), policy)


def results(paths: str | Path | Iterable[str | Path]) -> "pd.DataFrame":
    """Returns the evaluations of all runs in folders; see `agents.runs.results.results`."""
    from agents.runs import results  # noqa: PLC0415  training needs no files

    return results.results(paths)
