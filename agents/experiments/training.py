"""Training of an experiment: its folder, the runs in it, and what is still missing."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from agents.config import Config
from agents.experiments.protocol import FIXED, Protocol
from agents.parallel.sharding import Placement
from agents.ppo.learner import make_train
from agents.runs.folder import CONFIG_FILE, Run, RunFolder, is_done, read_json, write_json
from agents.runs.machine import machine
from agents.runs.metrics import Row, read_metrics
from agents.runs.session import Session
from agents.runs.stopping import StopSignals
from agents.runs.tracking import Tracker
from trap_tube_jax.scoring.tasks import Purpose, evaluation_tasks
from trap_tube_jax.state import State

PROTOCOL_FILE = "experiment.json"
FOLDER_NAME = re.compile(r"(?P<algorithm>.+)-seed\d+(to\d+)?")


class AlgorithmRun(NamedTuple):
    """A run of an experiment, as far as it got.

    Attributes:
      algorithm: its name.
      folder: its files.
      run: what it trains.
      rows: its rows of metrics.
    """

    algorithm: str
    folder: RunFolder
    run: Run
    rows: Sequence[Row]


def open_experiment(
    root: Path, experiment: str, defaults: Protocol, given: Mapping[str, Any], *, create: bool
) -> Protocol:
    """The protocol of the experiment in a folder.

    Args:
      root: the folder.
      experiment: which of `PROTOCOLS`.
      defaults: what holds where the folder holds no experiment yet.
      given: values that go before the defaults and before what the folder says.
      create: make or update the folder; otherwise it must hold an experiment.

    Raises:
      ValueError: a value is not allowed, or contradicts what is in the folder.
    """
    stored = read_json(root / PROTOCOL_FILE)
    if stored is None and not create:
        raise ValueError(f"{root} holds no experiment")
    if stored is not None:
        if stored.pop("experiment", None) != experiment:
            raise ValueError(f"{root} holds another experiment than {experiment}")
        defaults = Protocol.from_dict({**stored, "seed": defaults.seed})
    protocol = dataclasses.replace(defaults, **given)
    for field in FIXED if stored is not None else ():
        before, now = getattr(defaults, field), getattr(protocol, field)
        if before != now:
            raise ValueError(f"{root} has {field}={before}, not {now}; use another --name")
    configs = [protocol.config(algorithm) for algorithm in protocol.algorithms]
    if create:
        for config in configs:
            make_train(config)  # refuses what cannot be trained with, before anything is
        root.mkdir(parents=True, exist_ok=True)
        values = {"experiment": experiment, **dataclasses.asdict(protocol)}
        write_json(root / PROTOCOL_FILE, values)
    return protocol


def train_all(
    root: Path,
    protocol: Protocol,
    console: Console,
    stop: StopSignals,
    *,
    side_by_side: bool,
    devices: int | str | None,
    checkpoint_every: int,
    commit: str | None,
) -> None:
    """Trains what is missing, seed after seed, the algorithms in turn.

    The last four are options of `python -m agents.experiments --help`: how runs are trained,
    which changes nothing of what they come to.

    Raises:
      ValueError: a run in the folder has other settings.
      Stopped: on request; everything is saved.
    """
    configs = {name: protocol.config(name) for name in protocol.algorithms}
    seeds = range(protocol.seed, protocol.seed + protocol.seeds)
    planned = plan_runs(root, configs, protocol.preset, seeds, side_by_side=side_by_side)
    todo = [(folder, run) for folder, run in planned if not is_done(folder, run)]
    if not todo:
        return
    tasks = draw_tasks(todo[0][1].config, protocol.sets, protocol.tasks, protocol.selects_on)
    for number, (folder, run) in enumerate(todo, 1):
        console.rule(f"run {number} of {len(todo)}: {folder.path.name}")
        placement = Placement.of(devices, run.config, run.seeds)
        note_machine(folder, placement, commit)
        tracker = Tracker(folder, run, tasks, ranked=protocol.ranked, every=protocol.evaluate_every)
        session = Session(
            folder,
            run,
            console,
            checkpoint_every=checkpoint_every,
            keep=2,
            tracker=tracker,
            placement=placement,
        )
        folder.note(run)  # more iterations, once it has been taken up
        try:
            session.train(stop)
            session.summarize()
        finally:
            session.close()


def plan_runs(
    root: Path,
    configs: Mapping[str, Config],
    preset: str,
    wanted: range,
    *,
    side_by_side: bool = False,
) -> list[tuple[RunFolder, Run]]:
    """The runs in a folder that hold these seeds, made where they are missing, by seed.

    Args:
      root: the folder.
      configs: the settings of the runs, by the name that their folders begin with.
      preset: the preset that they started from.
      wanted: the seeds.
      side_by_side: make one run of all missing seeds that follow each other.

    Raises:
      ValueError: a run has other settings.
    """
    planned: list[tuple[RunFolder, Run]] = []
    there = find_runs(root)
    for name, config in configs.items():
        seen: set[int] = set()
        for entry in there:
            if entry.algorithm == name and set(entry.run.seed_range) & set(wanted):
                seen |= set(entry.run.seed_range)
                planned.append((entry.folder, _continued(entry, config)))
        missing = [range(seed, seed + 1) for seed in wanted if seed not in seen]
        for seeds in _joined(missing) if side_by_side else missing:
            run = Run(config, preset, seeds[0], len(seeds))
            planned.append((RunFolder(root / folder_name(name, seeds)), run))
    planned.sort(key=lambda entry: entry[1].seed)  # stable: the configs in turn
    for folder, run in planned:
        if not folder.config.is_file():
            RunFolder.create(folder.path, run)
    return planned


def draw_tasks(
    config: Config, sets: Sequence[str], num_tasks: int, purpose: Purpose
) -> dict[str, State]:
    """The fixed evaluation tasks of the sets."""
    return {name: evaluation_tasks(name, num_tasks, config.num_features, purpose) for name in sets}


def note_machine(folder: RunFolder, placement: Placement, commit: str | None) -> None:
    """Adds this machine, with the devices that train, to those that a run ran on."""
    known = read_json(folder.machines) or []
    here = {**machine(commit), "devices": placement.devices}
    if here not in known:
        write_json(folder.machines, [*known, here])


def folder_name(algorithm: str, seeds: range) -> str:
    """The name of the folder of a run within that of its experiment."""
    last = f"to{seeds[-1]}" if len(seeds) > 1 else ""
    return f"{algorithm}-seed{seeds[0]}{last}"


def find_runs(root: Path) -> list[AlgorithmRun]:
    """All runs in the folder of an experiment, by algorithm and seed.

    Raises:
      ValueError: the settings of a run cannot be read.
    """
    found = []
    for path in root.glob(f"*/{CONFIG_FILE}"):
        match = FOLDER_NAME.fullmatch(path.parent.name)
        if match:
            folder, run = RunFolder.open(path.parent)
            rows = read_metrics(folder.metrics)
            found.append(AlgorithmRun(match["algorithm"], folder, run, rows))
    return sorted(found, key=lambda entry: (entry.algorithm, entry.run.seed))


def _continued(entry: AlgorithmRun, config: Config) -> Run:
    run = dataclasses.replace(entry.run, config=config)
    try:
        run.check_continues(entry.run)
    except ValueError as error:
        raise ValueError(f"{entry.folder.path}: {error}; use another --name") from error
    return run


def _joined(ranges: Sequence[range]) -> list[range]:
    """The ranges with adjacent ones put together."""
    joined: list[range] = []
    for seeds in ranges:
        if joined and joined[-1].stop == seeds.start:
            joined[-1] = range(joined[-1].start, seeds.stop)
        else:
            joined.append(seeds)
    return joined
