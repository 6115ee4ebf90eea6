"""What the experiments train, on what, for how long: one table each.

Source: paper section "Results"; its Tables 1 and 2.
"""

import dataclasses
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any, Self

from agents.config import Config
from agents.registry import curiosities
from trap_tube_jax.imports import import_modules
from trap_tube_jax.registry import task_set
from trap_tube_jax.scoring.tasks import ALL_SETS, Purpose

PROGRAM = "python -m agents.experiments"
PRESET = "preset"


def algorithms() -> dict[str, dict[str, Any]]:
    """What each algorithm changes in a preset, whichever that is.

    `ppo` is PPO alone. `+<curiosity>` adds that curiosity, with the preset's weight. `preset` is
    the preset as it is.
    """
    named = {f"ppo+{name}": {"curiosity": name} for name in curiosities if name != "none"}
    return {"ppo": {"curiosity": "none"}, **named, PRESET: {}}


def changes_of(algorithm: str) -> dict[str, Any]:
    """What one algorithm changes in a preset.

    Args:
      algorithm: one of `algorithms()`, and settings after it, as in `preset,recurrent=false`.

    Raises:
      ValueError: there is no such algorithm, or a setting is not NAME=VALUE or none that an
        algorithm may change.
    """
    name, *settings = re.split(COMMA, algorithm)
    if name not in algorithms():
        raise ValueError(f"unknown algorithm {name!r}; allowed: {', '.join(algorithms())}")
    own = dict(map(parse_setting, settings))
    for setting in OF_TASKS:
        if setting in own:
            raise ValueError(
                f"{setting} is the same for all algorithms; give it by --settings, "
                f"not in {algorithm!r}"
            )
    return {**algorithms()[name], **own}


def parse_setting(text: str) -> tuple[str, Any]:
    """The name and the value of a setting given as NAME=VALUE.

    Raises:
      ValueError: it is given otherwise, or has an option of its own.
    """
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"settings are given as NAME=VALUE, got {text!r}")
    _check_setting(name)
    return name, parse_value(value)


def _check_setting(name: str) -> None:
    if name in OWN_OPTIONS:
        raise ValueError(f"{name} is none of --settings; give {OWN_OPTIONS[name]}")


def parse_value(text: str) -> Any:
    """A value as JSON has it; other text is itself."""
    try:
        return json.loads(text)
    except ValueError:
        return text


COMMA = re.compile(r",(?![^\[]*\])")  # but not those in a list
# Settings of the tasks, on which all algorithms of an experiment are compared.
OF_TASKS = ("max_steps", "num_features")
SELECTIONS = ("validation", "paper")
# Settings of the config that a protocol has by other means, and the options that give them.
OWN_OPTIONS = {
    "imports": "--import",
    "env_id": "--train-set",
    "iterations": "--iterations",
    "eval_episodes": "--tasks",
    "stop_when_solved": "--stop-when-solved",
}


@dataclasses.dataclass(frozen=True)
class Protocol:
    """How an experiment is run: the options of `python -m agents.experiments --help`.

    What differs from there:

    Attributes:
      train_set: by its short name.
      sets: by their short names.
      algorithms: as `changes_of` reads them.
      selection: one of `SELECTIONS`.
      settings: by name, their values parsed.
    """

    train_set: str = "base"
    sets: tuple[str, ...] = ALL_SETS
    imports: tuple[str, ...] = ()
    preset: str = "paper"
    algorithms: tuple[str, ...] = ("ppo", "ppo+icm")
    seeds: int = 5
    iterations: int = 250
    tasks: int = 128
    reported: int = 1000
    selection: str = "validation"
    evaluate_every: int = 1
    stop_when_solved: float = 0.0
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    seed: int = 0

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        import_modules(self.imports)
        for name in (self.train_set, *self.sets):
            task_set(name)
        if not self.sets:
            raise ValueError(f"name at least one task set; allowed: {', '.join(ALL_SETS)}, ...")
        for name in self.algorithms:
            changes_of(name)
        for name in self.settings:
            _check_setting(name)
        for name in ("seeds", "tasks", "reported", "evaluate_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be >= 1, got {getattr(self, name)}")
        if not self.algorithms:
            raise ValueError(f"name at least one algorithm; allowed: {', '.join(algorithms())}")
        if self.selection not in SELECTIONS:
            raise ValueError(
                f"selection must be one of {', '.join(SELECTIONS)}, got {self.selection!r}"
            )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of `dataclasses.asdict`, also from JSON.

        Raises:
          ValueError: a value is unknown, missing or not allowed.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for name in values:
            if name not in known:
                raise ValueError(f"unknown {name!r} in a protocol; allowed: {', '.join(known)}")
        missing = [name for name in known if name not in values]
        if missing:
            raise ValueError(f"a protocol lacks {', '.join(missing)}")
        read: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in values.items()
        }
        return cls(**read)

    @property
    def ranked(self) -> tuple[str, ...]:
        """The sets whose mean decides which evaluation is the best.

        All, but base, which is a single task, only where it is what is trained on.
        """
        many = tuple(name for name in self.sets if name != "base" or self.train_set == "base")
        return many or self.sets

    @property
    def selects_on(self) -> Purpose:
        """Which tasks choose the best evaluation."""
        return "validation" if self.selection == "validation" else "test"

    @property
    def num_reported(self) -> int:
        """Tasks per set that the tables report."""
        return self.reported if self.selection == "validation" else self.tasks

    def config(self, algorithm: str) -> Config:
        """The settings of an algorithm's runs.

        Raises:
          ValueError: unknown preset or setting, or a setting's value is not allowed.
        """
        fixed = {
            "env_id": task_set(self.train_set).id,
            "iterations": self.iterations,
            "eval_episodes": self.tasks,
            "stop_when_solved": self.stop_when_solved,
        }
        changes = changes_of(algorithm)
        return Config.preset(self.preset, **{**self.settings, **fixed, **changes})

    def command(
        self, experiment: str, algorithms: Sequence[str], devices: int | None = None
    ) -> str:
        """What to type for the same runs in a new folder.

        Args:
          experiment: which of `PROTOCOLS`.
          algorithms: the algorithms of the runs.
          devices: how many each run was trained on, as sums of other numbers round otherwise;
            None if unknown.
        """
        usual = PROTOCOLS[experiment]
        parts = [experiment]
        parts += [part for name in self.imports for part in ("--import", name)]
        if self.train_set != usual.train_set:
            parts += ["--train-set", self.train_set]
        if self.sets != usual.sets:
            parts += ["--sets", *self.sets]
        parts += ["--preset", self.preset, "--algorithms", *algorithms]
        names = ("seeds", "iterations", "tasks", "reported", "selection", "evaluate_every")
        for name in (*names, "stop_when_solved", "seed"):
            value = getattr(self, name)
            if value != getattr(usual, name):
                parts += [f"--{name.replace('_', '-')}", str(value)]
        if self.settings:
            parts.append("--settings")
        for name, value in self.settings.items():
            parts.append(f"{name}={json.dumps(value, separators=(',', ':'))}")
        if devices is not None:
            parts += ["--devices", str(devices)]
        return f"{PROGRAM} {shlex.join(parts)}"


# Nothing of these may differ between the runs of one folder.
FIXED = (
    *("train_set", "sets", "imports", "preset", "tasks", "selection", "evaluate_every"),
    *("stop_when_solved", "settings"),
)

PROTOCOLS = {
    "exp1": Protocol(iterations=250),
    "exp2": Protocol(train_set="pstsy", iterations=500),
}
# Some minutes on two cores: too short for the paper's numbers, long enough to see that the
# curiosity of the `fast` preset finds the food where PPO alone does not.
SHORT = Protocol(
    preset="fast", algorithms=("ppo", PRESET), seeds=1, tasks=16, reported=128, evaluate_every=5
)
QUICK = {
    "exp1": dataclasses.replace(SHORT, iterations=20, stop_when_solved=1.0),
    "exp2": dataclasses.replace(SHORT, train_set="pstsy", iterations=15),
}
