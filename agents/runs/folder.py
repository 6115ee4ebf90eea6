"""The folder of one run: its files and its lock."""

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import filelock

from agents.files import read_json, write_json
from agents.runs.run import Run, RunOptions
from trap_tube_jax._version import __version__
from trap_tube_jax.imports import import_modules

CONFIG_FILE = "config.json"


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
