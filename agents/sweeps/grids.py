"""Grids of settings and seeds: the options of their commands, and the named grids."""

import dataclasses
import itertools
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import trap_tube_jax as tt
from agents.command_line import option
from agents.config import Config
from agents.ppo.learner import make_learner
from agents.runs.folder import RunFolder, check_name
from agents.runs.run import Run, RunOptions
from trap_tube_jax.checks import check_integer

COMMA = re.compile(r",(?![^\[]*\])")  # but not within a list


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains every point of a grid of settings with every seed, several runs at a time.

    Each run has a folder, as with agents.train. The grid's folder also holds results.csv, with
    a row per run, evaluation and task set, table.md and figures. Ctrl-C saves all runs; repeating
    the command resumes them. Adding seeds or values of a setting extends the grid.

    Attributes:
      settings: settings of all runs as NAME=VALUE, or of a grid as NAME=VALUE,VALUE; a list is
        [VALUE,VALUE].
      imports: modules to import first, which register curiosities, encoders or task sets.
      preset: named settings to start from.
      env: task set to train on, by id or short name, by default the preset's.
      only: names of the points to train, by default all.
      seeds: number of seeds.
      seed: the first seed.
      name: the grid's folder within --out, by default named after grid, preset and task set.
      out: the folder of all grids.
      processes: programs at a time, by default one per core, or one on a GPU or TPU.
      seeds_per_program: seeds of a point that one program trains, by default all on a GPU or TPU
        if the encoder is `objects`, else one.
      cluster: address of a Dask scheduler whose workers train the runs, as in tcp://HOST:8786.
    """

    settings: tuple[str, ...] = ()
    imports: tuple[str, ...] = option((), append=True, flags=("--import",))
    preset: str = "fast"
    env: str | None = None
    only: tuple[str, ...] = ()
    seeds: int = 1
    seed: int = 0
    name: str | None = None
    out: Path = Path("runs")
    processes: int | None = None
    seeds_per_program: int | None = None
    cluster: str | None = None


@dataclasses.dataclass(frozen=True)
class Grid:
    """A named grid.

    Attributes:
      options: defaults of its command line.
      run_options: defaults of the options of every run.
      settings: settings of all points, which the command line may replace.
      points: settings by the name of the point. Tables compare the others with the first one.
      about: a line of help.
    """

    options: Options = dataclasses.field(default_factory=Options)
    run_options: RunOptions = dataclasses.field(default_factory=RunOptions)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    points: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=lambda: {"": {}})
    about: str = ""

    def make_runs(self, name: str, options: Options, run_options: RunOptions) -> dict[Path, Run]:
        """Returns the runs by their folders, seed after seed.

        Args:
          name: beginning of the name of the grid's folder.
          options: of the grid.
          run_options: of every run.

        Raises:
          ValueError: an option is not allowed.
        """
        check_integer("seeds", options.seeds)
        for limit in ("processes", "seeds_per_program"):
            if getattr(options, limit) is not None:
                check_integer(limit, getattr(options, limit))
        if (options.seeds_per_program or 1) > 1 and (run_options.devices or 1) > 1:
            raise ValueError("several seeds_per_program use one device; leave out --devices")
        points = self.configs(options)
        names = {tt.task_set(config.env_id).short for config in points.values()}
        short = names.pop() if len(names) == 1 else "sets"
        if (options.preset, short) != (self.options.preset, self.options.env):
            name = f"{name}-{options.preset}-{short}"
        name = name if options.name is None else options.name
        check_name(name)
        for point in options.only:
            if point not in points:
                raise ValueError(f"no point {point!r}; allowed: {', '.join(points)}")
        configs = {point: points[point] for point in options.only or points}
        for config in configs.values():
            make_learner(config)  # refuses what cannot be trained with
        root = options.out / name
        if RunFolder(root).config.is_file():
            raise ValueError(f"{root} is a run; give another --name")
        runs = {}
        for seed in range(options.seed, options.seed + options.seeds):
            for point, config in configs.items():
                path = root / f"{point}-seed{seed}"
                check_name(path.name)
                runs[path] = Run(config, seed, point, options.imports)
        return runs

    def configs(self, options: Options) -> dict[str, Config]:
        """Returns the settings of every point by its name, whatever `options.only` chooses."""
        given = dict(map(_parse, options.settings))
        if len(given) < len(options.settings):
            raise ValueError(f"give a setting only once, got {' '.join(options.settings)}")
        if options.env != self.options.env and "env_id" in given:
            raise ValueError("give --env or --settings env_id=..., not both")
        fixed = sorted({name for point in self.points.values() for name in point} & given.keys())
        if fixed:
            raise ValueError(f"the grid's points decide {', '.join(fixed)}; use --only")
        common = {**self.settings, **({} if options.env is None else {"env_id": options.env})}
        configs = {}
        for name, *labels in itertools.product(self.points, *given.values()):
            chosen = {k: given[k][label] for k, label in zip(given, labels, strict=True)}
            point = ",".join(filter(None, [name, *labels])) or options.preset
            settings = {**common, **chosen, **self.points[name]}
            configs[point] = Config.preset(options.preset, **settings)
        return configs


def _parse(text: str) -> tuple[str, dict[str, Any]]:
    """Reads NAME=VALUE,VALUE; returns the name and its values by their part of a point's name."""
    name, _, values = text.partition("=")
    if not values:
        raise ValueError(f"give settings as NAME=VALUE,VALUE, got {text!r}")
    if len(texts := COMMA.split(values)) == 1:
        return name, {"": _value(values)}
    return name, {f"{name}={text.strip('[]').replace(',', 'x')}": _value(text) for text in texts}


def _value(text: str) -> Any:
    python = {"True": True, "False": False, "None": None}
    try:
        return python[text] if text in python else json.loads(text)
    except ValueError:
        return text


# Source of `exp1` and `exp2`: the paper's section "Results".
PAPER_POINTS = {"ppo": {"curiosity": "none"}, "ppo+icm": {"curiosity": "icm"}}
# What the published code may have run under these names. Its flag for PPO without ICM switches off
# only the losses, so the error of an untrained forward model stays a bonus (`ppo+bonus`). It reads
# the previous action and reward only if asked to (`ppo+icm-blind` does not).
CODE_POINTS = {
    **PAPER_POINTS,
    "ppo+bonus": {"curiosity": "icm", "curiosity_coef": 0.0},
    "ppo+icm-blind": {"curiosity": "icm", "previous_inputs": False},
}
PAPER_RUN = RunOptions(evaluate_every=1, test_tasks=1000)
BEST_RUN = RunOptions(evaluate_every=20, test_tasks=1000)
CURIOSITIES = ("effects", "rnd", "noveld", "icm")
# Preset `best`, and without one ingredient at a time.
INGREDIENT_POINTS: dict[str, dict[str, Any]] = {
    "best": {},
    "known-colors": {"object_colors": True},
    "paper-encoder": {"encoder": "paper", "filters": (32, 64)},
    "unturned": {"align_to_food": False},
    "no-motion": {"motion_coef": 0.0},
    "no-replay": {"replay_fractions": ()},
    "rnd": {"curiosity": "rnd"},
    "noveld": {"curiosity": "noveld"},
    "repeats": {"repeat_penalty": 0.0},
    "no-memory": {"recurrent": False},
    "paper-ppo": {"epochs": 10, "discount": 0.99, "value_coef": 0.01, "entropy_coef": 1e-4},
}

GRIDS = {
    "exp1": Grid(
        Options(preset="paper", env="base", seeds=5),
        PAPER_RUN,
        {"iterations": 250},
        PAPER_POINTS,
        "the paper's Experiment 1: base, with and without ICM; hours",
    ),
    "exp2": Grid(
        Options(preset="paper", env="pstsy", seeds=5),
        PAPER_RUN,
        {"iterations": 500},
        PAPER_POINTS,
        "the paper's Table 2: {P, St, Sy}, with and without ICM; days",
    ),
    "exp1-code": Grid(
        Options(preset="paper", env="base", seeds=5),
        PAPER_RUN,
        {"iterations": 250},
        CODE_POINTS,
        "exp1, and what the published code may have run; hours",
    ),
    "exp2-code": Grid(
        Options(preset="paper", env="pstsy", seeds=5),
        PAPER_RUN,
        {"iterations": 500},
        CODE_POINTS,
        "exp2, and what the published code may have run; days",
    ),
    "fast": Grid(
        Options(preset="fast", env="base", seeds=10),
        RunOptions(evaluate_every=100, test_tasks=1000),
        about="preset fast on base; a minute per seed",
    ),
    "best": Grid(
        Options(preset="best", env="pstsy", seeds=5),
        BEST_RUN,
        about="preset best on {P, St, Sy}; 40 to 130 minutes per seed",
    ),
    "curiosities": Grid(
        Options(preset="best", env="pstsy", seeds=5),
        BEST_RUN,
        {"iterations": 312},
        {
            **{f"ppo+{name}": {"curiosity": name} for name in CURIOSITIES},
            "ppo": {"curiosity": "none"},
        },
        "preset best with every intrinsic reward; 7 hours on one core",
    ),
    "ingredients": Grid(
        Options(preset="best", env="pstsy", seeds=8, seed=10),
        BEST_RUN,
        {"iterations": 360, "max_transitions": 8_000_000},
        INGREDIENT_POINTS,
        "preset best without one ingredient at a time; a day on one core",
    ),
}
