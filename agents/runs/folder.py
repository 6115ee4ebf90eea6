"""The folder of one run: where its files lie, and its settings in `config.json`."""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import Any, Self

from agents.config import PRESETS, Config
from agents.runs.metrics import is_last, read_metrics
from trap_tube_jax._version import __version__

CONFIG_FILE = "config.json"
MAX_SEED = 2**31 - 1
# Settings that may change when a run is resumed: they decide only where it ends.
EXTENDABLE = ("iterations", "max_transitions", "stop_when_solved")
FIRST_VERSION = "0.1.0"  # wrote settings without a version
# Settings that are gone. They said how a policy is trained; it acts without them.
GONE = (
    *("method", "task_sets", "tasks", "walkers", "walk_rounds", "walk_steps", "agent_rounds"),
    *("restarts", "advised", "advice", "dataset", "mirrored"),
    *("imitation_coef", "imitation_episodes", "episodic_novelty"),
)


@dataclasses.dataclass(frozen=True)
class Run:
    """What a run trains; with the code it fixes the result.

    Attributes:
      config: the settings.
      preset: the preset that the settings started from.
      seed: the first seed.
      seeds: how many seeds are trained side by side, from `seed` on.
    """

    config: Config
    preset: str = "paper"
    seed: int = 0
    seeds: int = 1

    def __post_init__(self) -> None:
        """Checks preset and seeds.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        if self.preset not in PRESETS:
            raise ValueError(f"unknown preset {self.preset!r}; allowed: {', '.join(PRESETS)}")
        for name, low in (("seed", 0), ("seeds", 1)):
            value = getattr(self, name)
            if type(value) is not int or value < low:
                raise ValueError(f"{name} must be an integer >= {low}, got {value!r}")
        if self.seed_range[-1] > MAX_SEED:
            raise ValueError(f"seeds must be at most {MAX_SEED}, got {self.seed_range[-1]}")

    @property
    def seed_range(self) -> range:
        """All seeds."""
        return range(self.seed, self.seed + self.seeds)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return dataclasses.asdict(self)

    def check_continues(self, before: "Run") -> None:
        """Checks that continuing `before` as this run gives what this run alone would have given.

        Args:
          before: the stored run.

        Raises:
          ValueError: a setting differs that shapes what has been trained so far.
        """
        old, new = (run._shaping() for run in (before, self))
        for name, value in old.items():
            if name not in (*EXTENDABLE, "config") and new[name] != value:
                raise ValueError(
                    f"the run has {name}={value}, not {new[name]}; only "
                    f"{', '.join(EXTENDABLE[:-1])} and {EXTENDABLE[-1]} may change"
                )
        for name in ("cooldown", "intrinsic_coef_init"):
            if old[name] > 0 and new["iterations"] != old["iterations"]:
                raise ValueError(
                    f"the run has {name}={old[name]} and iterations={old['iterations']}, not "
                    f"{new['iterations']}: its schedule depends on their number, so another "
                    "number of them is another run; begin a new one"
                )

    def _shaping(self) -> dict[str, Any]:
        """All values, flat; `max_steps` is the limit that holds for the training set."""
        config = self.config
        limit = config.step_limit(config.env_id)
        return {**self.to_dict(), **config.to_dict(), "max_steps": limit}

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """The inverse of `to_dict`.

        Missing settings are the paper's; those that are gone are dropped if PPO trained the run.

        Raises:
          ValueError: a value is missing, unknown or not allowed.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(values, dict) or sorted(values) != sorted(names):
            raise ValueError(f"a run is described by {', '.join(names)}, got {values!r}")
        if not isinstance(values["config"], dict):
            raise ValueError(f"config must be a table of settings, got {values['config']!r}")
        config = values["config"]
        if config.get("method", "ppo") == "ppo":
            config = {name: value for name, value in config.items() if name not in GONE}
        return cls(**{**values, "config": Config.from_dict(config)})


class RunFolder:
    """The files of a run.

    Attributes:
      path: the folder.
      config: the settings.
      metrics: a row per seed and iteration.
      checkpoints: one folder per checkpoint, named after its iteration.
      log: what its training showed, where it ran beside others.
      curves: the learning curves.
      page: all of it on one page, to open in a browser.
      evaluation: greedy evaluation on all task sets.
      summary: when each seed was first solved, and what that took.
      machines: what it ran on, as far as an experiment noted it.
      animation: a solved episode.
      is_new: whether `create` has made it.
    """

    def __init__(self, path: Path):
        self.path = path
        self.is_new = False
        self.config = path / CONFIG_FILE
        self.metrics = path / "metrics.csv"
        self.checkpoints = path / "checkpoints"
        self.log = path / "log.txt"
        self.curves = path / "curves.png"
        self.page = path / "report.html"
        self.evaluation = path / "evaluation.json"
        self.summary = path / "summary.json"
        self.machines = path / "machines.json"
        self.animation = path / "solved.gif"

    def best(self, seed: int, iteration: int) -> Path:
        """The parameters of a seed's evaluation on several sets that was the best until then."""
        return self.path / f"best-seed{seed}-iteration{iteration}.safetensors"

    def kept_best(self, seed: int) -> dict[int, Path]:
        """The files of these parameters, by iteration, in order; the last is the best."""
        prefix = f"best-seed{seed}-iteration"
        paths = self.path.glob(f"{prefix}*.safetensors")
        kept = {int(path.stem.removeprefix(prefix)): path for path in paths}
        return dict(sorted(kept.items()))

    def tested(self, seed: int) -> Path:
        """The steps that these parameters take in the tasks that are reported."""
        return self.path / f"tested-seed{seed}.json"

    @classmethod
    def create(cls, path: Path, run: Run) -> Self:
        """Makes the folder of a new run.

        Raises:
          ValueError: there is something already.
        """
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            advice = "is taken, and holds no run; give another --name"
            if (path / CONFIG_FILE).is_file():
                advice = "is not empty; give --resume to continue the run in it, or another --name"
            raise ValueError(f"{path} {advice}")
        # The folder appears together with its settings, so that a kill leaves either no run
        # or one that can be resumed.
        draft = path.parent / f".{path.name}.{os.getpid()}"
        draft.mkdir(parents=True)
        cls(draft).note(run)
        draft.rename(path)
        folder = cls(path)
        folder.is_new = True
        return folder

    def remove_if_new(self) -> None:
        """Removes the folder if `create` has made it, for a run that failed before it saved."""
        if self.is_new:
            shutil.rmtree(self.path)

    @classmethod
    def open(cls, path: Path) -> tuple[Self, Run]:
        """The folder of an existing run, and the run.

        Raises:
          ValueError: there is none, its settings cannot be read, or a module that it imports is
            missing.
        """
        folder = cls(path)
        if not folder.config.is_file():
            known = sorted(entry.parent.name for entry in path.parent.glob(f"*/{CONFIG_FILE}"))
            raise ValueError(
                f"{path} holds no run; runs in {path.parent}: {', '.join(known) or 'none'}"
            )
        version = __version__
        try:
            values = json.loads(folder.config.read_text())
            if isinstance(values, dict):
                version = values.pop("version", FIRST_VERSION)
            return folder, Run.from_dict(values)
        except ValueError as error:
            if isinstance(error.__cause__, ModuleNotFoundError):
                raise ValueError(f"the run in {path} needs a module of yours: {error}") from error
            raise ValueError(
                f"{folder.config} is not the settings of a run: {error}; version {version} wrote "
                f"it, this is {__version__}"
            ) from error

    def note(self, run: Run) -> None:
        """Writes the settings of a run, and which version does."""
        write_json(self.config, {"version": __version__, **run.to_dict()})


def check_name(name: str, what: str = "folder") -> None:
    """Checks that a name is a plain name, not a path.

    Raises:
      ValueError: it is empty, or a path.
    """
    if Path(name).name != name or name in ("", ".."):
        raise ValueError(f"name must be the name of a {what}, without a path, got {name!r}")


def is_done(folder: RunFolder, run: Run) -> bool:
    """Whether a run has been trained and summarised in full."""
    summary = read_json(folder.summary)
    if summary is None:
        return False
    # The summary may have been written under other limits, and the metrics may go on after it.
    rows = [
        row for row in read_metrics(folder.metrics) if row["iteration"] <= summary["iterations"]
    ]
    over = {row["seed"] for row in rows if is_last(row, run.config)}
    return over.issuperset(run.seed_range)


def write_json(path: Path, values: Any) -> None:
    """Writes a JSON file whole or not at all, and its folder; plain values share a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(_json(values) + "\n")
    draft.replace(path)


def _json(value: Any, indent: str = "") -> str:
    inner = indent + "  "
    if isinstance(value, dict) and value:
        lines = [f"{json.dumps(str(name))}: {_json(each, inner)}" for name, each in value.items()]
        start, end = "{}"
    elif isinstance(value, list | tuple) and any(isinstance(x, dict | list | tuple) for x in value):
        lines = [_json(each, inner) for each in value]
        start, end = "[]"
    else:
        return json.dumps(value, allow_nan=False)
    return f"{start}\n{inner}" + f",\n{inner}".join(lines) + f"\n{indent}{end}"


def read_json(path: Path) -> Any:
    """What a JSON file holds; None if there is no such file.

    Raises:
      ValueError: it is not JSON; the message names it.
    """
    if not path.exists():
        return None
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is not JSON: {error}") from error
