"""A training run: its settings and seed, and the options for carrying it out."""

import dataclasses
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, Self

import trap_tube_jax as tt
from agents.command_line import option
from agents.config import Config
from trap_tube_jax.checks import MAX_TASKS, check_integer, check_seed

# Settings that may change when a run is resumed: they decide only where it ends.
EXTENDABLE = ("iterations", "max_transitions", "stop_when_solved")
EVALUATION = ("evaluate_every", "sets", "test_tasks")  # options that a resumed run keeps


@dataclasses.dataclass(frozen=True)
class Run:
    """One training run; together with the code it determines the result.

    Attributes:
      config: the settings.
      seed: seed of all draws.
      algorithm: name in tables, by default `ppo+<curiosity>`, with `, fine-tuned` appended for a
        fine-tuned agent.
      imports: modules that registered names of the settings. They are recorded, and imported
        again only at the caller's request.
      finetune: agent whose parameters training starts from: a run's folder, a file of parameters
        or a shipped agent. Only the policy network's are taken.

    Example:
      >>> run = agents.Run(agents.Config.preset("fast", env_id="sy"), seed=1)
      >>> run.algorithm, run.config.env_id
      ('ppo+effects', 'SymbolicTrapTube-v0')
    """

    config: Config
    seed: int = 0
    algorithm: str = ""
    imports: tuple[str, ...] = ()
    finetune: str | Path | None = None

    def __post_init__(self) -> None:
        """Completes task set and algorithm; ValueError names a value that is not allowed."""
        object.__setattr__(self, "seed", check_seed(self.seed))
        object.__setattr__(self, "imports", check_names("imports", self.imports))
        env_id = tt.task_set(self.config.env_id).id
        object.__setattr__(self, "config", dataclasses.replace(self.config, env_id=env_id))
        if self.finetune is not None:
            object.__setattr__(self, "finetune", str(self.finetune))
        if not self.algorithm:
            curiosity = self.config.curiosity
            name = "ppo" if curiosity == "none" else f"ppo+{curiosity}"
            suffix = "" if self.finetune is None else ", fine-tuned"
            object.__setattr__(self, "algorithm", f"{name}{suffix}")

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """Inverts `to_dict`; ValueError names an unknown setting or a value that is not allowed."""
        config = Config.from_dict(values["config"])
        return cls(**{**values, "config": config, "imports": tuple(values["imports"])})


def check_names(option: str, names: Iterable[str]) -> tuple[str, ...]:
    """Returns names as a tuple; ValueError for a single name, whose letters would be taken."""
    if isinstance(names, str):
        raise ValueError(f"{option} must be a tuple of names, got {names!r}")
    return tuple(names)


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Options for carrying out a run; on one device, none of them changes what it learns.

    A resumed run keeps `evaluate_every`, `sets` and `test_tasks`, so that its evaluations can be
    compared.

    Attributes:
      devices: devices that share the run, by default one, or all if distributed.
      checkpoint_every: iterations between checkpoints.
      evaluate_every: iterations between evaluations on `sets`, 0 for none. The best evaluation,
        of equal ones the first, selects the parameters that the run reports.
      sets: sets to evaluate on, by default the paper's eight and the training set.
      test_tasks: test tasks per set, by default `eval_episodes`.
      report: writes curves, page and GIF at the end.
      tensorboard: logs metrics for TensorBoard.
      wandb: logs metrics to Weights & Biases; offline with WANDB_MODE=offline.

    Example:
      >>> agents.RunOptions(evaluate_every=10, sets=("p", "psy")).checkpoint_every
      10
    """

    devices: int | None = option(None, "devices and hosts")
    checkpoint_every: int = option(10, "run")
    evaluate_every: int = option(0, "run")
    sets: tuple[str, ...] | None = option(None, "run")
    test_tasks: int | None = option(None, "run")
    report: bool = option(True, "run")
    tensorboard: bool = option(False, "run")
    wandb: bool = option(False, "run")

    def __post_init__(self) -> None:
        """Raises ValueError for a number that is not allowed or an unknown set."""
        bounds = {"checkpoint_every": (1, None), "evaluate_every": (0, None)}
        optional = {"devices": (1, None), "test_tasks": (1, MAX_TASKS)}
        bounds |= {name: x for name, x in optional.items() if getattr(self, name) is not None}
        for name, limits in bounds.items():
            object.__setattr__(self, name, check_integer(name, getattr(self, name), *limits))
        if self.sets is None:
            return
        object.__setattr__(self, "sets", check_names("sets", self.sets))
        if not self.sets:
            raise ValueError("sets must name one or more task sets, or be None for the default")
        for name in self.sets:
            tt.task_set(name)


def check_continues(
    path: Path,
    before: tuple[Run, RunOptions],
    after: tuple[Run, RunOptions],
    may_change: Collection[str] = EXTENDABLE,
) -> None:
    """Checks that a run of other settings would have the results so far of a stored one.

    Only the evaluation at the end of `before` may differ: it counts for the choice of the best
    policy.

    Args:
      path: the stored run's folder.
      before: the stored run and its options.
      after: the run to train and its options.
      may_change: settings that may differ; of them, schedules fix the number of iterations.

    Raises:
      ValueError: another setting, or how the run is evaluated, differs.
    """
    old, new = (
        {**run.to_dict(), **run.config.to_dict(), **{x: getattr(options, x) for x in EVALUATION}}
        for run, options in (before, after)
    )
    free = set(may_change) - ({"iterations"} if before[0].config.has_schedule else set())
    for name, value in old.items():
        if name not in {*free, "config", "imports"} and new[name] != value:
            raise ValueError(
                f"{path} has {name}={value}, not {new[name]}; "
                f"{', '.join(sorted(free)) or 'nothing'} may change; train with other settings "
                "under another --name, and play other tasks with python -m agents.evaluate"
            )
