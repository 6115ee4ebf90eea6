"""What the experiments train, on what, for how long: one table each.

Source: agent specification "Experiments"; paper section "Results".
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, Self

from agents.config import Config
from agents.evaluate import ALL_SETS

# What an algorithm changes in a preset.
ALGORITHMS: dict[str, dict[str, Any]] = {
    "ppo": {"curiosity": "none"},
    "ppo+icm": {"curiosity": "icm"},
    "ppo+icm-detached": {"curiosity": "icm-detached"},
    "ppo+rnd": {"curiosity": "rnd"},
    "ppo+counts": {"curiosity": "counts"},
    "preset": {},
}


class Experiment(NamedTuple):
    """What an experiment trains on and by what it ranks evaluations.

    Attributes:
      title: what to call it.
      env_id: the task set to train on.
      ranked: the sets whose mean decides which evaluation is the best overall.
    """

    title: str
    env_id: str
    ranked: tuple[str, ...]


EXPERIMENTS = {
    "exp1": Experiment("Experiment 1: train on base", "TrapTube-v0", ALL_SETS),
    "exp2": Experiment(
        "Experiment 2: train on {P, St, Sy}",
        "PerceptualStructuralSymbolicTrapTube-v0",
        ALL_SETS[1:],
    ),
}


@dataclasses.dataclass(frozen=True)
class Protocol:
    """How an experiment is run.

    Attributes:
      preset: the named settings.
      algorithms: which of `ALGORITHMS`.
      seeds: how many, from `seed` on.
      iterations: of training, at most.
      tasks: evaluation tasks per set; the base set has one.
      evaluate_every: iterations from one evaluation on all sets to the next.
      stop_when_solved: as in the config.
      settings: settings of the config that differ from the preset's.
      seed: the first seed.
    """

    preset: str = "paper"
    algorithms: tuple[str, ...] = ("ppo", "ppo+icm")
    seeds: int = 5
    iterations: int = 250
    tasks: int = 128
    evaluate_every: int = 1
    stop_when_solved: float = 0.0
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuses what cannot be run.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        for name in self.algorithms:
            if name not in ALGORITHMS:
                allowed = ", ".join(ALGORITHMS)
                raise ValueError(f"unknown algorithm {name!r}; allowed: {allowed}")
        for name in ("seeds", "tasks", "evaluate_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be >= 1, got {getattr(self, name)}")
        if not self.algorithms:
            raise ValueError(f"name at least one algorithm; allowed: {', '.join(ALGORITHMS)}")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of `dataclasses.asdict`, also from JSON.

        Raises:
          ValueError: a value is unknown, or not allowed.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for name in values:
            if name not in known:
                raise ValueError(f"unknown {name!r} in a protocol; allowed: {', '.join(known)}")
        return cls(**{**values, "algorithms": tuple(values["algorithms"])})

    def config(self, experiment: Experiment, algorithm: str) -> Config:
        """The settings of an algorithm's runs.

        Raises:
          ValueError: unknown preset or setting, or a setting's value is not allowed.
        """
        fixed = {
            "env_id": experiment.env_id,
            "iterations": self.iterations,
            "eval_episodes": self.tasks,
            "stop_when_solved": self.stop_when_solved,
        }
        return Config.preset(self.preset, **{**self.settings, **fixed, **ALGORITHMS[algorithm]})


# Nothing of these may differ between the runs of one folder.
FIXED = ("preset", "tasks", "evaluate_every", "stop_when_solved", "settings")

PROTOCOLS = {
    "exp1": Protocol(iterations=250),
    "exp2": Protocol(iterations=500),
}
# Some minutes on two cores: too short for the paper's numbers, long enough to see that the
# `fast` preset's curiosity and imitation find the food where plain PPO does not.
QUICK = {
    "exp1": Protocol(
        preset="fast",
        algorithms=("ppo", "preset"),
        seeds=1,
        iterations=20,
        tasks=16,
        evaluate_every=5,
        stop_when_solved=1.0,
    ),
    "exp2": Protocol(
        preset="fast",
        algorithms=("ppo", "preset"),
        seeds=1,
        iterations=15,
        tasks=16,
        evaluate_every=5,
    ),
}
