"""A grid of settings, every point with several seeds: python -m agents.sweep --help."""

import dataclasses
import itertools
import json
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro
from rich.console import Console

import trap_tube_jax as tt
from agents.command_line import Imports
from agents.config import PRESETS, Config
from agents.experiments import figures, workers
from agents.experiments.protocol import parse_value
from agents.experiments.statistics import Spread
from agents.experiments.tables import SPREAD, spread_text
from agents.experiments.training import FOLDER_NAME, find_runs, plan_runs
from agents.ppo.learner import make_train
from agents.runs.folder import check_name, is_done, write_json
from agents.runs.results import results
from agents.runs.stopping import AGAIN, Stopped, StopSignals
from agents.runs.table import Table
from trap_tube_jax.command_line import plain_errors

PERCENT = "percent_"


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains every combination of settings with every seed, several runs at a time.

    Everything lands in one folder: a run folder for each combination and seed, as agents.train
    makes them, and a table, a figure and the records of them all. The same command again
    continues where it was stopped or killed; more seeds, or more values of a setting that has
    several, add to what is there.

    Attributes:
      settings: what varies, as NAME=VALUE,VALUE; a single value holds for all runs.
      imports: modules of your own to import first, for the curiosities, encoders and task sets
        that they register.
      preset: the named settings to start from.
      env: the task set to train on, by id or short name.
      seeds: how many seeds, from --seed on.
      seed: the first seed.
      name: the folder within --out; sweep-<preset>-<task set> if absent.
      out: the folder of all runs.
      processes: how many runs to train at a time; as many as there are cores on a CPU, and one
        on other devices, if absent.
    """

    settings: tuple[str, ...] = ()
    imports: Imports = ()
    preset: Annotated[str, tyro.conf.arg(metavar="|".join(PRESETS))] = "fast"
    env: str | None = None
    seeds: int = 1
    seed: int = 0
    name: str | None = None
    out: Path = Path("runs")
    processes: int | None = None

    def __post_init__(self) -> None:
        """Checks the numbers and the name.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        for name in ("seeds", "processes"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be >= 1, got {value}")
        if self.name is not None:
            check_name(self.name)

    def configs(self) -> dict[str, Config]:
        """The settings of every point of the grid, by its name.

        Raises:
          ValueError: a setting is not NAME=VALUES, unknown, given twice, or not allowed.
        """
        values = dict(map(_values, self.settings))
        if len(values) < len(self.settings):
            raise ValueError(f"a setting may be given only once, got {' '.join(self.settings)}")
        if self.env is not None and "env_id" in values:
            raise ValueError(f"give --env {self.env} or the setting env_id, not both")
        given = {} if self.env is None else {"env_id": self.env}
        configs = {}
        for point in itertools.product(*values.values()):
            settings = dict(zip(values, point, strict=True))
            config = Config.preset(self.preset, **{**given, **settings})
            config = dataclasses.replace(config, env_id=tt.task_set(config.env_id).id)
            make_train(config)  # refuses what cannot be trained with
            varied = {name: settings[name] for name in values if len(values[name]) > 1}
            configs[point_name(varied) or self.preset] = config
        return configs


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    console = Console()
    stop = StopSignals(lambda: console.print(f"Finishing these iterations; {AGAIN}."))
    try:
        with plain_errors():
            options = tyro.cli(Options, args=arguments, prog="python -m agents.sweep")
            jax.config.update("jax_platforms", "cpu")  # leaves other devices to the runs
            failed = run(options, console, stop)
    except (Stopped, KeyboardInterrupt):
        console.print("Stopped. The same command continues.")
        raise SystemExit(128 + (stop.received or signal.SIGINT)) from None
    raise SystemExit(1 if failed else 0)


def run(options: Options, console: Console, stop: StopSignals) -> int:
    """Trains what is missing, and shows what there is; how many runs failed.

    Raises:
      ValueError: an option is not allowed, or a run in the folder has other settings.
      Stopped: on request; everything is saved.
    """
    configs = options.configs()
    env = tt.task_set(next(iter(configs.values())).env_id)
    root = options.out / (options.name or f"sweep-{options.preset}-{env.short}")
    seeds = range(options.seed, options.seed + options.seeds)
    planned = plan_runs(root, configs, options.preset, seeds)
    todo = [
        (folder, planned_run)
        for folder, planned_run in planned
        if not (is_done(folder, planned_run) and folder.evaluation.is_file())
    ]
    failed = []
    if todo:
        processes = options.processes or workers.default_processes()
        console.print(f"{root}: {len(todo)} of {len(planned)} runs to train, {processes} at a time")
        failed = workers.train_runs(todo, processes, console, stop)
    report(root, console)
    return len(failed)


def report(root: Path, console: Console) -> None:
    """Writes records, table and figure of all runs in a folder, and shows the table."""
    files = {
        "records": root / "results.json",
        "table": root / "table.md",
        "figure": root / "curves.png",
    }
    records = results(root)
    write_json(files["records"], records)
    made = table(records, root.name)
    files["table"].write_text(f"# {made.title}\n\n{made.to_markdown()}\n", encoding="utf-8")
    rows: dict[str, list[Any]] = {}
    for entry in find_runs(root):
        rows.setdefault(entry.algorithm, []).extend(entry.rows)
    curves = {name: found for name, found in rows.items() if found}
    if curves:
        figures.save_rewards(curves, files["figure"], root.name)
    console.print(made.to_rich())
    for name, path in files.items():
        console.print(f"{name:>10}: {path}", soft_wrap=True, highlight=False)


def table(records: Sequence[dict[str, Any]], title: str) -> Table:
    """A row for each point of the grid: means over seeds, deviations and 95 % intervals.

    Args:
      records: as `results` gives them.
      title: above it.
    """
    points: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        match = FOLDER_NAME.fullmatch(Path(record["run"]).name)
        if match:
            points.setdefault(match["algorithm"], []).append(record)
    sets = [name for name in records[0] if name.startswith(PERCENT)]
    heads = ("settings", "seeds", "finished", "solved", "episodes until solved", "greedy %")
    rows = []
    for name, seeds in points.items():
        evaluated = [seed["evaluation"] for seed in seeds]
        percents = [None if share is None else 100 * share for share in evaluated]
        cells = [
            name,
            str(len(seeds)),
            str(sum(seed["finished"] for seed in seeds)),
            str(sum(seed["solved_episodes"] is not None for seed in seeds)),
            spread_text(Spread.of([seed["solved_episodes"] for seed in seeds]), ",.0f"),
            _percent(percents),
            *(_percent([seed[column] for seed in seeds]) for column in sets),
        ]
        rows.append(tuple(cells))
    labels = (f"{name.removeprefix(PERCENT)} %" for name in sets)
    return Table(f"{title}: {SPREAD}", (*heads, *labels), tuple(rows))


def point_name(settings: dict[str, Any]) -> str:
    """What to call a point of the grid, and the folders of its runs."""
    return ",".join(f"{name}={_text(value)}" for name, value in settings.items())


def _percent(values: Sequence[float | None]) -> str:
    return spread_text(Spread.of(values), ".1f", high=100.0)


def _values(text: str) -> tuple[str, list[Any]]:
    name, equals, values = text.partition("=")
    if not equals or not values:
        raise ValueError(f"settings are given as NAME=VALUE,VALUE, got {text!r}")
    try:
        return name, json.loads(f"[{values}]")
    except ValueError:
        return name, [parse_value(value) for value in values.split(",")]


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "x".join(map(_text, value))
    return value if isinstance(value, str) else json.dumps(value)


if __name__ == "__main__":
    main()
