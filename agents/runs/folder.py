"""The folder of one run: its files, its settings in `config.json`, and the lock of its writer."""

import contextlib
import dataclasses
import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import filelock

from agents.config import PRESETS, Config
from agents.files import read_json, write_json
from trap_tube_jax._version import __version__
from trap_tube_jax.imports import import_modules

CONFIG_FILE = "config.json"
MAX_SEED = 2**31 - 1
# Settings that may change when a run is resumed: they decide only where it ends.
EXTENDABLE = ("iterations", "max_transitions", "stop_when_solved")


@dataclasses.dataclass(frozen=True)
class Run:
    """One training run; together with the code it determines the result.

    Attributes:
      config: the settings.
      preset: the preset that the settings started from.
      seed: the first seed.
      seeds: number of seeds trained side by side, from `seed` on.
      algorithm: name in tables; `ppo+<curiosity>` if empty.
      imports: modules that registered names of the settings. They are recorded, and imported
        again only at the caller's request.
    """

    config: Config
    preset: str = "paper"
    seed: int = 0
    seeds: int = 1
    algorithm: str = ""
    imports: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Names the algorithm; ValueError names the allowed values of preset and seeds."""
        if self.preset not in PRESETS:
            raise ValueError(f"unknown preset {self.preset!r}; allowed: {', '.join(PRESETS)}")
        for name, low, high in (("seed", 0, MAX_SEED), ("seeds", 1, 65_536)):
            value = getattr(self, name)
            if type(value) is not int or not low <= value <= high:
                raise ValueError(f"{name} must be an integer in [{low}, {high}], got {value!r}")
        if not self.algorithm:
            curiosity = self.config.curiosity
            name = "ppo" if curiosity == "none" else f"ppo+{curiosity}"
            object.__setattr__(self, "algorithm", name)

    @property
    def seed_range(self) -> range:
        """All seeds."""
        return range(self.seed, self.seed + self.seeds)

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """Inverts `to_dict`; ValueError names a value that is missing, unknown or not allowed."""
        names = sorted(field.name for field in dataclasses.fields(cls))
        if sorted(values) != names or not isinstance(values["config"], dict):
            raise ValueError(f"expected a table of {', '.join(names)}, config a table of settings")
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
                    f"only {', '.join(sorted(free & set(EXTENDABLE)))} may change"
                )


class RunFolder:
    """The files of a run.

    Attributes:
      path: the folder.
      config: settings, JSON.
      provenance: machines, versions and commits that trained it, JSON.
      metrics: a row per seed and iteration, CSV.
      evaluations: a row per seed, evaluated iteration and task set, CSV.
      checkpoints: a file per checkpoint, named by its iteration.
      curves: learning curves, PNG.
      page: the report, HTML.
      animation: a solved episode, GIF.
    """

    def __init__(self, path: Path):
        self.path = path
        self.config = path / CONFIG_FILE
        self.provenance = path / "provenance.json"
        self.metrics = path / "metrics.csv"
        self.evaluations = path / "evaluations.csv"
        self.checkpoints = path / "checkpoints"
        self.curves = path / "curves.png"
        self.page = path / "report.html"
        self.animation = path / "solved.gif"

    def best(self, seed: int) -> Path:
        """Returns the file of a seed's parameters with the best evaluation so far."""
        return self.path / f"best-seed{seed}.safetensors"

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Makes this process the folder's only writer; makes the folder if missing.

        Raises ValueError if another process writes to it, OSError if it cannot be made.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        lock, holder = filelock.FileLock(self.path / ".lock", timeout=0), self.path / ".writer"
        try:
            lock.acquire()
        except filelock.Timeout:
            name = holder.read_text() if holder.is_file() else "another process"
            raise ValueError(f"{self.path} is being written by {name}; wait for its end") from None
        try:
            holder.write_text(f"process {os.getpid()} on {socket.gethostname()}")
            yield
        finally:
            holder.unlink(missing_ok=True)
            lock.release()

    @contextlib.contextmanager
    def opened_for(self, run: Run) -> Iterator[None]:
        """Locks the folder for training a new run or continuing the stored one.

        A new folder in which nothing was saved is removed at the end. Raises the errors of `lock`,
        `check_free` and `Run.check_continues`.
        """
        with self.lock():
            if self.config.is_file():
                run.check_continues(self.read())
                yield
                return
            self.check_free()
            self.note(run)
            try:
                yield
            finally:
                if not (self.metrics.exists() or self.checkpoints.exists()):
                    shutil.rmtree(self.path, ignore_errors=True)

    def check_free(self) -> None:
        """Raises ValueError unless a new run can be created here."""
        if self.config.is_file():
            raise ValueError(
                f"{self.path} holds a run; continue it with --resume {self.path}, or give "
                "another --name"
            )
        hidden = self.path.is_dir() and all(p.name.startswith(".") for p in self.path.iterdir())
        if self.path.exists() and not hidden:
            raise ValueError(f"{self.path} is taken, and holds no run; give another --name")

    def note(self, run: Run) -> None:
        """Writes the settings of a run and the version of this package."""
        write_json(self.config, {"version": __version__, **run.to_dict()})

    def read(self, imports: tuple[str, ...] = ()) -> Run:
        """Returns the stored run.

        Args:
          imports: modules to import first, which register names of the settings.

        Raises:
          ValueError: there is no run, or its settings cannot be read.
        """
        import_modules(imports)
        if not self.config.is_file():
            raise ValueError(f"{self.path} holds no run; {runs_next_to(self.path)}")
        values = read_json(self.config)
        if not isinstance(values, dict):
            raise ValueError(f"{self.config} must be a table of settings")
        version, needs = values.pop("version", "unknown"), values.get("imports") or ()
        try:
            return Run.from_dict(values)
        except (ValueError, TypeError) as error:
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
    if not name or Path(name).name != name or name.startswith("."):
        raise ValueError(f"name must be a folder's name without a path, got {name!r}")
