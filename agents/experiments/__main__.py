"""The paper's two experiments from the command line: python -m agents.experiments --help.

Source: agent specification "Experiments"; paper section "Results".
"""

import dataclasses
import json
import operator
import shlex
import signal
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress as Bar

import trap_tube_jax as tt
from agents.config import PRESETS, Config
from agents.evaluate import ALL_SETS, evaluation_tasks, shortest_lengths
from agents.experiments import figures, results, tables
from agents.experiments.protocol import (
    ALGORITHMS,
    EXPERIMENTS,
    FIXED,
    PROTOCOLS,
    QUICK,
    Experiment,
    Protocol,
)
from agents.experiments.results import AlgorithmRun
from agents.parallel.sharding import Placement
from agents.runs import compilation_cache
from agents.runs.folder import Run, RunFolder, read_json, write_json
from agents.runs.machine import machine
from agents.runs.session import Session, Stopped, StopSignals
from agents.runs.tracking import Tracker
from trap_tube_jax.state import State

PROGRAM = "python -m agents.experiments"
PROTOCOL_FILE = "experiment.json"
SHORTEST_FILE = "shortest.json"
SOLVED_AT_ONCE = 8  # tasks whose shortest plans are found between two saves

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


@dataclasses.dataclass(frozen=True)
class Options:
    """Runs an experiment of the paper and writes its tables and figures.

    Everything lands in one folder: a run folder for each algorithm and seed, as
    agents.train makes them, and the tables, figures and summary of them all. The same
    command again continues where it was stopped or killed, to the same result; with more
    seeds, algorithms or iterations it adds to what is there. What an option leaves open is
    decided by the folder, if it exists, and else by the paper's protocol.

    Attributes:
      experiment: exp1 trains on base, exp2 on {P, St, Sy}.
      preset: the named settings; the paper's if absent.
      algorithms: ppo, ppo+icm, ppo+icm-detached, ppo+rnd, ppo+counts: the preset with that
        curiosity; preset: as it is. ppo and ppo+icm if absent.
      seeds: how many seeds, from --seed on; 5 if absent.
      seed: the first seed; 0 if absent.
      iterations: of training; 250 in exp1 and 500 in exp2 if absent.
      tasks: fixed evaluation tasks per set; 128 if absent. The base set has one.
      evaluate_every: iterations from one greedy evaluation on all sets to the next; 1 if
        absent. Where a run first solves its training set, it is evaluated in any case.
      stop_when_solved: stop a run early once it solves this share of its training set's
        tasks; 0, never, if absent.
      settings: further settings of the config, as NAME=VALUE.
      quick: the reduced protocol: the fast preset, ppo and preset, 1 seed, 16 tasks per set,
        evaluated every 5 iterations; exp1 20 iterations or until solved, exp2 15 iterations.
      side_by_side: train all missing seeds of an algorithm at once, for a GPU.
      devices: how many devices share a run's episodes and seeds, or `all` there are; one if
        absent.
      name: the folder within --out; <experiment>-<preset> if absent, with -quick.
      out: the folder of all runs.
      report_only: train nothing; draw tables and figures from what there is.
      no_optimality: do not search for shortest plans, to compare solved episodes with.
      record: also write the summary to this file.
      commit: the commit to note where git does not tell it.
      checkpoint_every: iterations from one checkpoint to the next.
      no_cache: compile everything anew, instead of keeping compiled programs in
        ~/.cache/trap_tube_jax from one time to the next.
    """

    experiment: Annotated[Literal["exp1", "exp2"], tyro.conf.Positional]
    preset: Annotated[str | None, tyro.conf.arg(metavar="|".join(PRESETS))] = None
    algorithms: tuple[str, ...] | None = None
    seeds: int | None = None
    seed: int | None = None
    iterations: int | None = None
    tasks: int | None = None
    evaluate_every: int | None = None
    stop_when_solved: float | None = None
    settings: tuple[str, ...] | None = None
    quick: Flag = False
    side_by_side: Flag = False
    devices: int | Literal["all"] | None = None
    name: str | None = None
    out: Path = Path("runs")
    report_only: Flag = False
    no_optimality: Flag = False
    record: Path | None = None
    commit: str | None = None
    checkpoint_every: int = 10
    no_cache: Flag = False


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    console = Console()
    options = tyro.cli(Options, args=arguments, prog=PROGRAM)
    stop = StopSignals(lambda: console.print("Finishing this iteration; again to abandon it."))
    if not options.no_cache:
        compilation_cache.enable()
    try:
        root, protocol = open_experiment(options)
        if not options.report_only:
            train_all(root, protocol, options, console, stop)
        report(root, protocol, options, console)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    except (KeyboardInterrupt, Stopped):
        again = f"{PROGRAM} {shlex.join(arguments)}"
        console.print(f"Stopped. Continue with: {again}", soft_wrap=True, highlight=False)
        raise SystemExit(128 + (stop.received or signal.SIGINT)) from None


def open_experiment(options: Options) -> tuple[Path, Protocol]:
    """The experiment's folder, made if new, and its protocol.

    Raises:
      ValueError: an option is not allowed, or contradicts what is in the folder.
    """
    if options.checkpoint_every < 1:
        raise ValueError(f"checkpoint_every must be >= 1, got {options.checkpoint_every}")
    defaults = (QUICK if options.quick else PROTOCOLS)[options.experiment]
    suffix = "-quick" if options.quick else ""
    name = options.name or f"{options.experiment}-{options.preset or defaults.preset}{suffix}"
    if Path(name).name != name:
        raise ValueError(f"name must be the name of a folder, without a path, got {name!r}")
    root = options.out / name
    stored = read_json(root / PROTOCOL_FILE)
    if stored is None and options.report_only:
        raise ValueError(f"{root} holds no experiment")
    if stored is not None:
        if stored.pop("experiment", None) != options.experiment:
            raise ValueError(f"{root} holds another experiment than {options.experiment}")
        defaults = Protocol.from_dict({**stored, "seed": defaults.seed})
    protocol = dataclasses.replace(defaults, **_given(options))
    for field in FIXED if stored is not None else ():
        before, now = getattr(defaults, field), getattr(protocol, field)
        if before != now:
            raise ValueError(f"{root} has {field}={before}, not {now}; use another --name")
    for algorithm in protocol.algorithms:
        Run(protocol.config(EXPERIMENTS[options.experiment], algorithm), protocol.preset)
    if not options.report_only:
        root.mkdir(parents=True, exist_ok=True)
        values = {"experiment": options.experiment, **dataclasses.asdict(protocol)}
        write_json(root / PROTOCOL_FILE, values)
    return root, protocol


def train_all(
    root: Path, protocol: Protocol, options: Options, console: Console, stop: StopSignals
) -> None:
    """Trains what is missing, seed after seed, the algorithms in turn.

    Raises:
      ValueError: a run in the folder has other settings.
      Stopped: on request; everything is saved.
    """
    experiment = EXPERIMENTS[options.experiment]
    todo = [
        (folder, run)
        for folder, run in plan(root, protocol, experiment, options.side_by_side)
        if not is_done(folder, run)
    ]
    if not todo:
        return
    tasks = draw_tasks(protocol.config(experiment, protocol.algorithms[0]))
    for number, (folder, run) in enumerate(todo, 1):
        console.rule(f"run {number} of {len(todo)}: {folder.path.name}")
        note_machine(folder, options.commit)
        tracker = Tracker(
            folder, run, tasks, ranked=experiment.ranked, every=protocol.evaluate_every
        )
        session = Session(
            folder,
            run,
            console,
            checkpoint_every=options.checkpoint_every,
            keep=2,
            tracker=tracker,
            placement=Placement.of(options.devices, run.config, run.seeds),
        )
        write_json(folder.config, run.to_dict())  # more iterations, once it has been taken up
        try:
            session.train(stop)
            session.summarize()
        finally:
            session.close()


def plan(
    root: Path, protocol: Protocol, experiment: Experiment, side_by_side: bool
) -> Iterable[tuple[RunFolder, Run]]:
    """The runs that hold the protocol's seeds, made where they are missing, by seed.

    Raises:
      ValueError: a run has other settings than the protocol.
    """
    wanted = range(protocol.seed, protocol.seed + protocol.seeds)
    planned: list[tuple[RunFolder, Run]] = []
    there = results.find_runs(root)
    for algorithm in protocol.algorithms:
        config = protocol.config(experiment, algorithm)
        seen: set[int] = set()
        for entry in there:
            if entry.algorithm == algorithm and set(entry.run.seed_range) & set(wanted):
                _check_same(entry, config)
                seen |= set(entry.run.seed_range)
                planned.append((entry.folder, dataclasses.replace(entry.run, config=config)))
        missing = [range(seed, seed + 1) for seed in wanted if seed not in seen]
        for seeds in _joined(missing) if side_by_side else missing:
            run = Run(config, protocol.preset, seeds[0], len(seeds))
            path = root / results.folder_name(algorithm, seeds)
            planned.append((RunFolder(path), run))
    planned.sort(key=lambda entry: entry[1].seed)  # stable: algorithms in turn
    for folder, run in planned:
        if not folder.config.is_file():
            RunFolder.create(folder.path, run)
    return planned


def is_done(folder: RunFolder, run: Run) -> bool:
    """Whether a run has been trained and summarised in full."""
    summary = read_json(folder.summary)
    if summary is None:
        return False
    solved = all(seed["first_solved"] for seed in summary["seeds"])
    return summary["iterations"] >= run.config.iterations or (
        run.config.stop_when_solved > 0 and solved
    )


def draw_tasks(config: Config) -> dict[str, State]:
    """The fixed evaluation tasks of all sets."""
    return {
        name: evaluation_tasks(name, config.eval_episodes, config.num_features, config.max_steps)
        for name in ALL_SETS
    }


def note_machine(folder: RunFolder, commit: str | None) -> None:
    """Adds this machine to those that a run ran on."""
    known = read_json(folder.machines) or []
    here = machine()
    here["commit"] = here["commit"] or commit
    if here not in known:
        write_json(folder.machines, [*known, here])


def report(root: Path, protocol: Protocol, options: Options, console: Console) -> None:
    """Writes summary, tables and figures of all runs in the folder, and shows the tables.

    Raises:
      ValueError: there is no run yet, or one cannot be read.
    """
    runs = [entry for entry in results.find_runs(root) if entry.rows]
    if not runs:
        raise ValueError(f"{root} holds no run with a first iteration yet")
    tasks = draw_tasks(runs[0].run.config)
    shortest = None
    if not options.no_optimality:
        shortest = find_shortest(root / SHORTEST_FILE, tasks, console)
    grouped = {
        name: [entry for entry in runs if entry.algorithm == name]
        for name in ALGORITHMS
        if any(entry.algorithm == name for entry in runs)
    }
    record = {
        "experiment": options.experiment,
        **{name: getattr(protocol, name) for name in FIXED},
        "ranked": EXPERIMENTS[options.experiment].ranked,
        "equal_to_base": {name: equal_to_base(states) for name, states in tasks.items()},
        "command": command(options.experiment, whole_protocol(protocol, runs), list(grouped)),
        "algorithms": [
            results.algorithm_record(name, entries, shortest) for name, entries in grouped.items()
        ],
    }
    files = write_report(root, record, grouped)
    if options.record is not None:
        options.record.parent.mkdir(parents=True, exist_ok=True)
        write_json(options.record, record)
        files["record"] = options.record
    for table in tables.tables(record):
        console.print(table.to_rich())
    for line in tables.notes(record):
        console.print(line, soft_wrap=True, highlight=False)
    for name, path in files.items():
        console.print(f"{name:>10}: {path}", soft_wrap=True, highlight=False)


def write_report(
    root: Path, record: Mapping[str, Any], grouped: Mapping[str, Sequence[AlgorithmRun]]
) -> dict[str, Path]:
    """Writes the files of an experiment's record; returns where, by what they are."""
    title = f"{EXPERIMENTS[record['experiment']].title}, preset {record['preset']}"
    files = {
        "summary": root / "summary.json",
        "tables": root / "tables.md",
        "figure": root / "curves.png",
    }
    write_json(files["summary"], record)
    files["tables"].write_text(f"# {title}\n\n{tables.markdown(record)}\n")
    draw = figures.save_rewards if record["experiment"] == "exp1" else figures.save_success
    curves = {
        name: [row for entry in entries for row in entry.rows] for name, entries in grouped.items()
    }
    draw(curves, files["figure"], title)
    return files


def find_shortest(path: Path, tasks: Mapping[str, State], console: Console) -> dict[str, list[int]]:
    """The lengths of the shortest plans of every set's tasks, kept in a file as they are found.

    Raises:
      ValueError: the file cannot be read.
    """
    found: dict[str, list[int]] = read_json(path) or {}
    missing = sum(len(states.time) - len(found.get(name, ())) for name, states in tasks.items())
    if not missing:
        return found
    with Bar(console=console, transient=True) as bar:
        task = bar.add_task("Shortest plans", total=missing)
        for name, states in tasks.items():
            lengths = found.setdefault(name, [])
            while len(lengths) < len(states.time):
                part = slice(len(lengths), len(lengths) + SOLVED_AT_ONCE)
                block = shortest_lengths(jax.tree.map(operator.itemgetter(part), states)).tolist()
                lengths += block
                write_json(path, found)
                bar.advance(task, len(block))
    return found


def equal_to_base(tasks: State) -> float:
    """The percentage of tasks that equal the base task."""
    base = tt.base_state(tasks.palette.shape[-1])
    same = jax.tree.map(
        lambda x, y: np.all(np.asarray(x) == np.asarray(y), axis=tuple(range(1, x.ndim))),
        tasks,
        base,
    )
    return 100 * float(np.mean(np.all(jax.tree.leaves(same), axis=0)))


def whole_protocol(protocol: Protocol, runs: Sequence[AlgorithmRun]) -> Protocol:
    """The protocol that comes to all these runs at once."""
    seeds = [seed for entry in runs for seed in entry.run.seed_range]
    return dataclasses.replace(
        protocol,
        iterations=max(entry.run.config.iterations for entry in runs),
        seed=min(seeds),
        seeds=max(seeds) - min(seeds) + 1,
    )


def command(experiment: str, protocol: Protocol, algorithms: Sequence[str]) -> str:
    """What to type for the same runs in a new folder."""
    parts = [PROGRAM, experiment, "--preset", protocol.preset]
    parts += ["--algorithms", *algorithms]
    for name in ("seeds", "iterations", "tasks", "evaluate_every", "stop_when_solved", "seed"):
        value = getattr(protocol, name)
        if value != getattr(PROTOCOLS[experiment], name):
            parts += [f"--{name.replace('_', '-')}", str(value)]
    if protocol.settings:
        pairs = [f"{name}={json.dumps(value)}" for name, value in protocol.settings.items()]
        parts += ["--settings", *(pair.replace(" ", "") for pair in pairs)]
    return " ".join(parts)


def _given(options: Options) -> dict[str, Any]:
    """The options that were given, by their names in the protocol."""
    names = [field.name for field in dataclasses.fields(Protocol)]
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.settings is not None:
        given["settings"] = dict(_setting(text) for text in options.settings)
    return given


def _setting(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"settings are given as NAME=VALUE, got {text!r}")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


def _check_same(entry: AlgorithmRun, config: Config) -> None:
    before, now = entry.run.config.to_dict(), config.to_dict()
    for name, value in before.items():
        if name != "iterations" and now[name] != value:
            raise ValueError(
                f"{entry.folder.path} has {name}={value}, not {now[name]}; use another --name"
            )


def _joined(ranges: Sequence[range]) -> list[range]:
    """The ranges with adjacent ones put together."""
    joined: list[range] = []
    for seeds in ranges:
        if joined and joined[-1].stop == seeds.start:
            joined[-1] = range(joined[-1].start, seeds.stop)
        else:
            joined.append(seeds)
    return joined


if __name__ == "__main__":
    main()
