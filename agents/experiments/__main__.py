"""The paper's two experiments from the command line: python -m agents.experiments --help.

Source: paper section "Results".
"""

import dataclasses
import shlex
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from agents.command_line import Flag, Imports
from agents.config import PRESETS
from agents.experiments import records, reporting, training
from agents.experiments.protocol import PROGRAM, PROTOCOLS, QUICK, Protocol, parse_setting
from agents.parallel.cores import become_devices
from agents.runs import compilation
from agents.runs.folder import check_name, read_json, write_json
from agents.runs.stopping import AGAIN, Stopped, StopSignals
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import import_modules
from trap_tube_jax.registry import task_set


@dataclasses.dataclass(frozen=True)
class Options:
    """Runs an experiment of the paper and writes its tables and figures.

    Everything lands in one folder: a run folder for each algorithm and seed, as
    agents.train makes them, and the tables, figures and summary of them all. The same
    command again continues where it was stopped or killed, to the same result; with more
    seeds, algorithms or iterations it adds to what is there. What an option leaves open is
    decided by the folder, if it exists, and else by the paper's protocol.

    Attributes:
      experiment: exp1 trains on base, exp2 on {P, St, Sy}, unless --train-set says otherwise.
      train_set: the set to train on, by id or short name.
      sets: the sets to evaluate on; the paper's eight if absent.
      imports: modules of your own to import first, for the curiosities, encoders and sets that
        they register.
      preset: the named settings; the paper's if absent.
      algorithms: ppo: the preset without curiosity; ppo+icm, ppo+rnd and so on: with that
        curiosity; preset: as it is. Each may be followed by settings that it changes, as in
        preset,recurrent=false. ppo and ppo+icm if absent.
      seeds: how many seeds, from --seed on; 5 if absent.
      seed: the first seed; 0 if absent.
      iterations: of training; 250 in exp1 and 500 in exp2 if absent.
      tasks: validation tasks per set, by which each trial's best evaluation is chosen; 128
        if absent. The base set has one.
      reported: other tasks per set, which the tables report; 1,000 if absent.
      selection: paper chooses and reports on the same --tasks tasks, as the paper does;
        validation if absent.
      evaluate_every: iterations from one greedy evaluation on all sets to the next; 1 if
        absent. Where a run first solves its training set, it is evaluated in any case.
      stop_when_solved: stop a run early once it solves this share of its training set's
        tasks; 0, never, if absent.
      settings: further settings of the config, as NAME=VALUE.
      quick: the reduced protocol: the fast preset, ppo and preset, 1 seed, 16 tasks per set,
        evaluated every 5 iterations; exp1 20 iterations or until solved, exp2 15 iterations.
      side_by_side: train all missing seeds of an algorithm at once, for a GPU.
      devices: how many devices share a run's episodes and seeds, or `all` there are. On a CPU
        a device is a core, and up to 4 share them unless said otherwise; else one.
      name: the folder within --out; <experiment>-<preset> if absent, with the --train-set if
        one is given, and with -quick.
      out: the folder of all runs.
      report_only: train nothing; draw tables and figures from what there is.
      record: also write the record to this file; refused unless all of it is of committed
        code.
      commit: the commit to note where git does not tell it.
      checkpoint_every: iterations from one checkpoint to the next.
    """

    experiment: Annotated[Literal["exp1", "exp2"], tyro.conf.Positional]
    train_set: str | None = None
    sets: tuple[str, ...] | None = None
    imports: Imports = ()
    preset: Annotated[str | None, tyro.conf.arg(metavar="|".join(PRESETS))] = None
    algorithms: tuple[str, ...] | None = None
    seeds: int | None = None
    seed: int | None = None
    iterations: int | None = None
    tasks: int | None = None
    reported: int | None = None
    selection: Literal["validation", "paper"] | None = None
    evaluate_every: int | None = None
    stop_when_solved: float | None = None
    settings: tuple[str, ...] | None = None
    quick: Flag = False
    side_by_side: Flag = False
    devices: int | Literal["all"] | None = None
    name: str | None = None
    out: Path = Path("runs")
    report_only: Flag = False
    record: Path | None = None
    commit: str | None = None
    checkpoint_every: int = 10

    def __post_init__(self) -> None:
        """Checks what no protocol checks.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        if self.checkpoint_every < 1:
            raise ValueError(f"checkpoint_every must be >= 1, got {self.checkpoint_every}")
        if self.name is not None:
            check_name(self.name)

    @property
    def defaults(self) -> Protocol:
        """The protocol where neither an option nor the folder says otherwise."""
        return (QUICK if self.quick else PROTOCOLS)[self.experiment]

    @property
    def root(self) -> Path:
        """The experiment's folder."""
        parts = [self.experiment, self.preset or self.defaults.preset]
        parts += [] if self.train_set is None else [task_set(self.train_set).short]
        name = "-".join([*parts, *(["quick"] if self.quick else [])])
        return self.out / (self.name or name)

    def given(self) -> dict[str, Any]:
        """The options that were given, by their names in the protocol.

        Raises:
          ValueError: a setting is not NAME=VALUE, or there is no such set.
        """
        names = [field.name for field in dataclasses.fields(Protocol)]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        if not self.imports:
            del given["imports"]
        if self.train_set is not None:
            given["train_set"] = task_set(self.train_set).short
        if self.sets is not None:
            given["sets"] = tuple(task_set(name).short for name in self.sets)
        if self.settings is not None:
            given["settings"] = dict(map(parse_setting, self.settings))
        return given


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    console = Console()
    stop = StopSignals(lambda: console.print(f"Finishing this iteration; {AGAIN}."))
    try:
        with plain_errors():
            options = tyro.cli(Options, args=arguments, prog=PROGRAM)
            become_devices(options.devices)
            compilation.enable_cache()
            run(options, console, stop)
    except (KeyboardInterrupt, Stopped):
        again = f"{PROGRAM} {shlex.join(arguments)}"
        console.print(f"Stopped. Continue with: {again}", soft_wrap=True, highlight=False)
        raise SystemExit(128 + (stop.received or signal.SIGINT)) from None


def run(options: Options, console: Console, stop: StopSignals) -> None:
    """Trains and reports as the options say.

    Raises:
      ValueError: an option is not allowed, or a run cannot be continued or recorded.
      Stopped: on request; everything is saved.
    """
    import_modules(options.imports)
    root, experiment, create = options.root, options.experiment, not options.report_only
    if options.record is not None:  # before training, which would be in vain
        runs = [entry for entry in training.find_runs(root) if entry.rows]
        used = [each for run in runs for each in read_json(run.folder.machines) or ()]
        records.check_clean({"machines": used}, options.commit)
    protocol = training.open_experiment(
        root, experiment, options.defaults, options.given(), create=create
    )
    if create:
        training.train_all(
            root,
            protocol,
            console,
            stop,
            side_by_side=options.side_by_side,
            devices=options.devices,
            checkpoint_every=options.checkpoint_every,
            commit=options.commit,
        )
    record = reporting.make_record(root, experiment, protocol, console)
    reporting.report(root, record, console)
    if options.record is not None:
        records.check_clean(record, options.commit)
        write_json(options.record, record)
        console.print(f"    record: {options.record}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main()
