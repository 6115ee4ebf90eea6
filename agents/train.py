"""Training from the command line: python -m agents.train --help."""

import dataclasses
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

import trap_tube_jax as tt
from agents.command_line import Imports
from agents.config import PRESETS, Config
from agents.parallel import processes
from agents.parallel.devices import become_devices
from agents.runs import compilation, display
from agents.runs.folder import Run, RunFolder, check_name
from agents.runs.metrics import first_solved, read_rows
from agents.runs.session import RunOptions, train_run
from agents.runs.stopping import Stopped
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import import_modules

PROGRAM = "python -m agents.train"


@dataclasses.dataclass(frozen=True)
class Selection:
    """Options that are read first, because they decide the defaults of the settings.

    Attributes:
      preset: named settings to start from.
      env: task set to train on, by id or short name.
      imports: modules to import first, which register curiosities, encoders or task sets.
      resume: folder of a run to continue; its settings become the defaults, and only
        --iterations, --max-transitions and --stop-when-solved may change.
    """

    preset: Annotated[str, tyro.conf.arg(metavar="|".join(PRESETS))] = "fast"
    env: Annotated[str | None, tyro.conf.arg(aliases=("--env-id",))] = None
    imports: Annotated[Imports, tyro.conf.arg(aliases=("--imports",))] = ()
    resume: Path | None = None


class Settings(Config):
    """`Config` without the setting that `Selection` gives."""

    env_id: Annotated[str, tyro.conf.Suppress]


@dataclasses.dataclass(frozen=True)
class Options(Selection):
    """Trains an agent, evaluates it on all task sets and writes a folder of results.

    Ctrl-C stops after the current iteration and saves; --resume continues to the same result. A
    second Ctrl-C stops at once.

    Attributes:
      seed: the first seed.
      seeds: number of seeds to train side by side.
      name: the run's folder within --out; <preset>-<task set>-<seed> if absent.
      out: the folder of all runs.
      checkpoint_every: iterations from one checkpoint to the next.
      keep: number of newest checkpoints to keep.
      devices: number of devices that share the run; one if absent, all with --distributed.
    """

    seed: int = 0
    seeds: int = 1
    name: str | None = None
    out: Path = Path("runs")
    config: Annotated[Config, tyro.conf.arg(name="", constructor=Settings)] = dataclasses.field(
        default_factory=Config
    )
    checkpoint_every: int = 10
    keep: int = 3
    devices: int | None = None
    job: Annotated[processes.Job, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=processes.Job
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if None."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    with plain_errors():
        options, run = parse(arguments)
        train(options, run)


def parse(arguments: Sequence[str]) -> tuple[Options, Run]:
    """Reads a command line and, with --resume, the stored run.

    Raises:
      ValueError: a value is not allowed, or contradicts the stored run.
    """
    selection, _ = tyro.cli(
        Selection, args=arguments, prog=PROGRAM, add_help=False, return_unknown_args=True
    )
    import_modules(selection.imports)
    given = {} if selection.env is None else {"env_id": tt.task_set(selection.env).id}
    if selection.resume is None:
        config = Config.preset(selection.preset, **given)
        defaults = Options(preset=selection.preset, config=config)
    else:
        folder, stored = RunFolder.open(selection.resume, selection.imports)
        defaults = Options(
            preset=stored.preset,
            seed=stored.seed,
            seeds=stored.seeds,
            out=folder.path.parent,
            name=folder.path.name,
            config=dataclasses.replace(stored.config, **given),
        )
    options = tyro.cli(
        Options,
        args=arguments,
        prog=PROGRAM,
        default=defaults,
        config=(tyro.conf.OmitArgPrefixes,),
    )
    config = Config.from_dict(options.config.to_dict())
    config = dataclasses.replace(config, env_id=tt.task_set(config.env_id).id)
    return options, Run(
        config, options.preset, options.seed, options.seeds, imports=options.imports
    )


def train(options: Options, run: Run) -> None:
    """Trains a run, or continues it, and prints its results.

    Raises:
      SystemExit: training was stopped; the message says how to continue.
      ValueError: the run cannot be trained or continued.
      OSError: a file cannot be written.
    """
    become_devices(options.devices)
    options.job.join()
    console = Console(quiet=not processes.is_first())
    folder = RunFolder(run_path(options, run))
    if options.resume is None and processes.is_first():
        folder.check_free()
    compilation.enable_cache()
    again = f"Continue with: {display.resume_command(folder)}"
    run_options = RunOptions(options.checkpoint_every, options.keep, options.devices)
    try:
        train_run(folder.path, run, run_options, console=console)
    except (Stopped, KeyboardInterrupt) as stopped:
        console.print(f"Stopped. {again}", soft_wrap=True, highlight=False, markup=False)
        number = stopped.signal if isinstance(stopped, Stopped) else signal.SIGINT
        raise SystemExit(128 + number) from None
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(f"{error}. Saved checkpoints are kept. {again}") from error
    if processes.is_first():
        show(folder, run, console)


def show(folder: RunFolder, run: Run, console: Console) -> None:
    """Prints the scores of a finished run and a few facts."""
    rows = [row for row in read_rows(folder.evaluations) if row["purpose"] == "test"]
    newest = max(row["iteration"] for row in rows)
    tested = [row for row in rows if row["iteration"] == newest]
    metrics = read_rows(folder.metrics)
    solved = first_solved(metrics, run.seed_range, run.config.stop_when_solved)
    lines = [display.evaluation_table(tested), "", *display.summary(folder, run, tested, solved)]
    for line in lines:
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def run_path(options: Options, run: Run) -> Path:
    """Returns the run's folder.

    Raises:
      ValueError: the name is not a folder's name.
    """
    if options.resume is not None:
        return options.resume
    last = f"to{run.seed_range[-1]}" if run.seeds > 1 else ""
    short = tt.task_set(run.config.env_id).short
    name = options.name or f"{options.preset}-{short}-{run.seed}{last}"
    check_name(name)
    return options.out / name


if __name__ == "__main__":
    main()
