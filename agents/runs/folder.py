"""The folder of one run: its files and its lock."""

import dataclasses
import difflib
from pathlib import Path
from typing import Any

from agents.files import check_folder, naming_file, read_json, write_json
from agents.runs.run import Run, RunOptions
from trap_tube_jax._version import __version__
from trap_tube_jax.checks import expand
from trap_tube_jax.imports import import_modules

CONFIG_FILE = "config.json"
PROVENANCE_FILE = "provenance.json"
GRID_FILE = "grid.json"
RUNS = Path("runs")  # where agents.train puts them
MAX_LISTED = 10
STORED = ("config", "seed", "algorithm", "imports", "options")  # what config.json must hold


class RunFolder:
    """The files of a run; `~` in the path is the home folder."""

    def __init__(self, path: str | Path):
        self.path = path = expand(path)
        self.config = path / CONFIG_FILE  # settings and options
        self.provenance = path / PROVENANCE_FILE  # machines, versions and commits that trained it
        self.metrics = path / "metrics.csv"  # a row per iteration
        self.evaluations = path / "evaluations.csv"  # a row per evaluated iteration and task set
        self.start = path / "start.safetensors"  # the agent that a fine-tuned run started from
        self.best = path / "best.safetensors"  # the best evaluation's, with `evaluate_every`
        self.checkpoints = path / "checkpoints"  # files named by their iteration
        self.tensorboard = path / "tensorboard"
        self.curves = path / "curves.png"
        self.page = path / "report.html"
        self.animation = path / "solved.gif"

    @property
    def title(self) -> str:
        """The folder's name, also if its path is "." or ends in ".."."""
        return self.path.resolve().name

    def check_free(self) -> None:
        """Raises ValueError unless a new run can be created here."""
        names = {path.name for path in self.path.iterdir()} if self.path.exists() else set()
        if CONFIG_FILE in names:
            again = f"continue it with --resume {self.path}, or give another --name"
            raise ValueError(f"{self.path} holds a run; {again}")
        # A killed process may have left its lock, and a draft of config.json.
        drafts = {name for name in names if name.startswith(f".{CONFIG_FILE}.")}
        if names - drafts - {".lock"}:
            raise ValueError(f"{self.path} exists, but holds no run; give another --name")

    def write_config(self, run: Run, options: RunOptions | None = None) -> None:
        """Writes a run, its options and the version of this package."""
        values = {**run.to_dict(), "options": dataclasses.asdict(options or RunOptions())}
        write_json(self.config, {"version": __version__, **values})

    def stored(self) -> dict[str, Any]:
        """Reads config.json: a run, its options and the version that wrote it, as plain values.

        Looks up no name in the settings.

        Raises:
          ValueError: there is no run, or the file is damaged.
        """
        if not self.config.is_file():
            raise ValueError(f"{self.path} holds no run; {runs_near(self.path)}")
        values = read_json(self.config)
        with naming_file(self.config):
            return {**values, **{name: values[name] for name in STORED}}

    def devices(self) -> int | None:
        """Returns the stored option, None without a run; unlike `read`, needs no modules."""
        return self.stored()["options"].get("devices") if self.config.is_file() else None

    def read(self, imports: tuple[str, ...] = ()) -> tuple[Run, RunOptions]:
        """Returns the stored run and its options.

        First imports modules, which register names of the settings. Raises ValueError if there is
        no run, or its settings or options cannot be read.
        """
        import_modules(imports)
        values = self.stored()
        options = values.pop("options")
        version = values.pop("version", "unknown")
        try:
            sets = options.get("sets")
            options["sets"] = None if sets is None else tuple(sets)
            return Run.from_dict(values), RunOptions(**options)
        except (ValueError, TypeError) as error:
            missing = [f"--import {name}" for name in values["imports"] if name not in imports]
            hint = f"; it was trained with {' '.join(missing)}" if missing else ""
            raise ValueError(
                f"{self.config}, written by version {version}, cannot be read: {error}{hint}"
            ) from error


def check_output(path: Path) -> None:
    """Raises ValueError if a file cannot be written, or would replace one of a run."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder; give the path of a file")
    check_folder(path.parent)
    if run := run_of(path):
        raise ValueError(f"{path} is a file of the run {run.path}; give another path")
    if path.exists() and (path.parent / GRID_FILE).is_file():
        raise ValueError(f"{path} may be a file of a grid; give another path")


def run_of(path: Path) -> RunFolder | None:
    """Returns the run of which a path is a file; None if there is none."""
    for folder in map(RunFolder, (path.parent, path.parent.parent)):
        files = set(vars(folder).values()) - {folder.path}
        if folder.config.is_file() and (path in files or path.parent == folder.checkpoints):
            return folder
    return None


def runs_near(path: Path) -> str:
    """Returns a hint, for messages, that names the runs near a path that holds none."""
    if inside := _runs_in(path):
        return f"give one of its runs: {_listed(inside)}"
    known = [*_runs_in(path.parent), *_runs_in(RUNS)]
    names = [run.name for run in known]
    for name in difflib.get_close_matches(path.name, names, n=1):
        return f"did you mean {known[names.index(name)]}?"
    return f"runs in {path.parent}: {_listed(_runs_in(path.parent)) or 'none'}"


def _runs_in(path: Path) -> list[Path]:
    return sorted(entry.parent for entry in path.glob(f"*/{CONFIG_FILE}"))


def _listed(runs: list[Path]) -> str:
    more = ", ..." if len(runs) > MAX_LISTED else ""
    return ", ".join(run.name for run in runs[:MAX_LISTED]) + more


def check_name(name: str) -> None:
    """Raises ValueError unless a name is a plain folder name."""
    if Path(name).name != name or name[:1] in ("", ".", "-") or not name.isprintable():
        raise ValueError(
            f"name must be a folder's name without a path that begins with neither . nor -, got "
            f"{name!r}"
        )
