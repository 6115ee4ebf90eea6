"""The folder of one run: its files, its settings and options in `config.json`, and its lock."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import filelock

from agents.command_line import option
from agents.config import Config
from agents.files import read_json, write_json
from trap_tube_jax._version import __version__
from trap_tube_jax.checks import MOST_TASKS, check_integer
from trap_tube_jax.imports import import_modules
from trap_tube_jax.registry import task_set

CONFIG_FILE = "config.json"
MAX_SEED = 2**31 - 1
# Settings that may change when a run is resumed: they decide only where it ends.
EXTENDABLE = ("iterations", "max_transitions", "stop_when_solved")


@dataclasses.dataclass(frozen=True)
class Run:
    """One training run; together with the code it determines the result.

    Attributes:
      config: the settings.
      seed: seed of all draws.
      algorithm: name in tables; `ppo+<curiosity>` if empty.
      imports: modules that registered names of the settings. They are recorded, and imported
        again only at the caller's request.
    """

    config: Config
    seed: int = 0
    algorithm: str = ""
    imports: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Completes task set and algorithm; ValueError names an unknown set or a wrong seed."""
        check_integer("seed", self.seed, 0, MAX_SEED)
        env_id = task_set(self.config.env_id).id
        object.__setattr__(self, "config", dataclasses.replace(self.config, env_id=env_id))
        if not self.algorithm:
            curiosity = self.config.curiosity
            name = "ppo" if curiosity == "none" else f"ppo+{curiosity}"
            object.__setattr__(self, "algorithm", name)

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """Inverts `to_dict`; ValueError names a setting that is unknown or not allowed."""
        config = Config.from_dict(values["config"])
        return cls(**{**values, "config": config, "imports": tuple(values["imports"])})

    def check_continues(self, before: "Run") -> None:
        """Raises ValueError unless resuming `before` trains as this run alone would have."""
        old, new = ({**run.to_dict(), **run.config.to_dict()} for run in (before, self))
        scheduled = old["lr_decay_fraction"] > 0 or old["intrinsic_coef_init"] > 0
        free = {*EXTENDABLE, "config", "imports"} - ({"iterations"} if scheduled else set())
        for name, value in old.items():
            if name not in free and new[name] != value:
                reason = "schedules span this number; " if name == "iterations" else ""
                raise ValueError(
                    f"the run has {name}={value}, not {new[name]}; {reason}"
                    f"only {', '.join(sorted(free & set(EXTENDABLE)))} may change in a run; train "
                    "with other settings under another --name"
                )


@dataclasses.dataclass(frozen=True)
class DeviceOptions:
    """Options that take effect before JAX starts.

    Attributes:
      devices: devices that share the run, by default one, or all if distributed.
    """

    devices: int | None = option(None, "devices and hosts")


@dataclasses.dataclass(frozen=True)
class RunOptions(DeviceOptions):
    """Options for carrying out a run; on one device, none of them changes what it learns.

    Attributes:
      checkpoint_every: iterations between checkpoints.
      evaluate_every: iterations between evaluations on `sets`, 0 for none. The best evaluation
        selects the parameters that the run reports.
      sets: sets to evaluate on, by default the paper's eight and the training set.
      reported: test tasks per set in the final evaluation, by default `eval_episodes`.
      report: writes curves, page and GIF at the end.
      tensorboard: logs metrics for TensorBoard.
      wandb: logs metrics to Weights & Biases; offline with WANDB_MODE=offline.
    """

    checkpoint_every: int = option(10, "run")
    evaluate_every: int = option(0, "run")
    sets: tuple[str, ...] | None = option(None, "run")
    reported: int | None = option(None, "run")
    report: bool = option(True, "run")
    tensorboard: bool = option(False, "run")
    wandb: bool = option(False, "run")

    def __post_init__(self) -> None:
        """Raises ValueError for a number that is too small or an unknown set."""
        check_integer("checkpoint_every", self.checkpoint_every)
        check_integer("evaluate_every", self.evaluate_every, minimum=0)
        if self.reported is not None:
            check_integer("reported", self.reported, maximum=MOST_TASKS)
        for name in self.sets or ():
            task_set(name)


class RunFolder:
    """The files of a run."""

    def __init__(self, path: Path):
        self.path = path
        self.config = path / CONFIG_FILE  # settings and options
        self.provenance = path / "provenance.json"  # machines, versions and commits that trained it
        self.metrics = path / "metrics.csv"  # a row per iteration
        self.evaluations = path / "evaluations.csv"  # a row per evaluated iteration and task set
        self.best = path / "best.safetensors"  # the best evaluation's, with `evaluate_every`
        self.checkpoints = path / "checkpoints"  # a file each, named by its iteration
        self.curves = path / "curves.png"
        self.page = path / "report.html"
        self.animation = path / "solved.gif"

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Makes this process the folder's only writer; makes the folder if missing.

        Raises ValueError if another process writes to the folder, OSError if it cannot be created.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            with filelock.FileLock(self.path / ".lock", timeout=0):
                yield
        except filelock.Timeout:
            raise ValueError(
                f"{self.path} is being written by another process; wait for its end"
            ) from None

    def check_free(self) -> None:
        """Raises ValueError unless a new run can be created here."""
        if self.config.is_file():
            again = f"continue it with --resume {self.path}, or give another --name"
            raise ValueError(f"{self.path} holds a run; {again}")
        if self.path.exists() and any(each.name != ".lock" for each in self.path.iterdir()):
            raise ValueError(f"{self.path} exists, but holds no run; give another --name")

    def note(self, run: Run, options: RunOptions | None = None) -> None:
        """Writes a run, its options and the version of this package."""
        values = {**run.to_dict(), "options": dataclasses.asdict(options or RunOptions())}
        write_json(self.config, {"version": __version__, **values})

    def devices(self) -> int | None:
        """Returns the stored option; unlike `read`, needs no modules."""
        values = read_json(self.config) if self.config.is_file() else {}
        return values.get("options", {}).get("devices")

    def read(self, imports: tuple[str, ...] = ()) -> tuple[Run, RunOptions]:
        """Returns the stored run and its options.

        First imports modules, which register names of the settings. Raises ValueError if there is
        no run, or its settings or options cannot be read.
        """
        import_modules(imports)
        if not self.config.is_file():
            raise ValueError(f"{self.path} holds no run; {runs_next_to(self.path)}")
        version, needs = "unknown", ()
        try:
            values = read_json(self.config)
            version, needs = values.pop("version", version), values.get("imports", needs)
            options = values.pop("options", {})
            run, sets = Run.from_dict(values), options["sets"] and tuple(options["sets"])
            return run, RunOptions(**{**options, "sets": sets})
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            missing = "".join(f" --import {name}" for name in needs if name not in imports)
            hint = f"; it was trained with{missing}" if missing else ""
            raise ValueError(
                f"{self.config}, written by version {version}, cannot be read: {error}{hint}"
            ) from error


def runs_next_to(path: Path) -> str:
    """Lists the runs in the parent of a folder, for messages."""
    known = sorted(entry.parent.name for entry in path.parent.glob(f"*/{CONFIG_FILE}"))
    return f"runs in {path.parent}: {', '.join(known) or 'none'}"


def check_name(name: str) -> None:
    """Raises ValueError unless a name is a plain folder name."""
    if Path(name).name != name or name[:1] in ("", ".") or not name.isprintable():
        raise ValueError(f"name must be a folder's name without a path, got {name!r}")
