"""Training from the command line: python -m agents.train --help."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

import trap_tube_jax as tt
from agents.command_line import add_options, build, make_parser, option
from agents.config import Config
from agents.parallel import processes
from agents.parallel.devices import become_devices
from agents.runs import compilation, display
from agents.runs.folder import Run, RunFolder, check_name
from agents.runs.session import RunOptions, train_run
from agents.runs.stopping import Stopped, exit_code
from trap_tube_jax._version import __version__
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import import_modules
from trap_tube_jax.scoring.scores import Scores
from trap_tube_jax.scoring.tasks import PROTOCOL

PROGRAM = "python -m agents.train"


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains an agent, evaluates it on all task sets and writes a folder of results.

    Ctrl-C stops after the current iteration and saves; --resume continues to the same result.
    A second Ctrl-C stops at once.

    Attributes:
      preset: named settings to start from: fast, best or paper.
      env: task set to train on, by id or short name.
      seed: the first seed.
      seeds: number of seeds to train side by side.
      name: the run's folder within --out; <preset>-<task set>-<seed> if absent.
      out: the folder of all runs.
      resume: folder of a run to continue; its settings become the defaults, and only
        --iterations, --max-transitions and --stop-when-solved may change.
      imports: module to import first. It may register curiosities, encoders and task sets.
    """

    preset: str = option("fast", "run")
    env: str | None = option(None, "run", flags=("--env-id",))
    seed: int = option(0, "run")
    seeds: int = option(1, "run")
    name: str | None = option(None, "run")
    out: Path = option(Path("runs"), "run")
    resume: Path | None = option(None, "run")
    imports: tuple[str, ...] = option((), "run", append=True, flags=("--import",))


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if None."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    with plain_errors():
        train(*parse(arguments))


def parse(arguments: Sequence[str]) -> tuple[Options, Run, RunOptions, processes.Job]:
    """Reads a command line and, with --resume, the stored run.

    Raises:
      ValueError: a value is not allowed, or contradicts the stored run.
    """
    # The preset, or the stored run, decides the defaults of all other options.
    first, _ = _parser(Options(), Config.preset("fast")).parse_known_args(
        [argument for argument in arguments if argument not in ("-h", "--help")]
    )
    import_modules(first.imports)
    own: dict[str, Any] = {} if first.env is None else {"env_id": tt.task_set(first.env).id}
    defaults, config = Options(), Config.preset(first.preset, **own)
    if first.resume is not None:
        _, stored = RunFolder.open(first.resume, tuple(first.imports))
        defaults = Options(preset=stored.preset, seed=stored.seed, seeds=stored.seeds)
        config = dataclasses.replace(stored.config, **own)
    found = _parser(defaults, config).parse_args(arguments)
    options = build(Options, found)
    config = build(Config, found, env_id=tt.task_set(config.env_id).id)
    run = Run(config, options.preset, options.seed, options.seeds, imports=options.imports)
    return options, run, build(RunOptions, found), build(processes.Job, found)


def _parser(options: Options, config: Config) -> argparse.ArgumentParser:
    """Returns the parser with these defaults."""
    parser = make_parser(Options, PROGRAM)
    add_options(parser, Options, options)
    add_options(parser, Config, config, skip=("env_id",))
    add_options(parser, RunOptions)
    add_options(parser, processes.Job)
    return parser


def train(options: Options, run: Run, how: RunOptions, job: processes.Job) -> None:
    """Trains a run, or continues it, and prints its results.

    Raises:
      SystemExit: training was stopped; the message says how to continue.
      ValueError: the run cannot be trained or continued.
      OSError: a file cannot be written.
    """
    become_devices(how.devices)
    job.join()
    console = Console(quiet=not processes.is_first())
    folder = RunFolder(run_path(options, run))
    if options.resume is None:
        processes.on_first(folder.check_free)
    compilation.enable_cache()
    again = f"Continue with: {display.resume_command(folder)}"
    try:
        scores = train_run(folder.path, run, how, console=console)
    except (Stopped, KeyboardInterrupt) as stopped:
        display.say(console, f"Stopped. {again}")
        raise SystemExit(exit_code(stopped)) from None
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(f"{error}. Saved checkpoints are kept. {again}") from error
    tables = [str(Scores(PROTOCOL, __version__, None, tuple(each))) for each in scores.values()]
    for line in (*tables, *display.summary(folder, run, scores)):
        display.say(console, line)


def run_path(options: Options, run: Run) -> Path:
    """Returns the run's folder; ValueError if its name is a path."""
    if options.resume is not None:
        return options.resume
    last = f"to{run.seed_range[-1]}" if run.seeds > 1 else ""
    short = tt.task_set(run.config.env_id).short
    name = options.name or f"{options.preset}-{short}-{run.seed}{last}"
    check_name(name)
    return options.out / name


if __name__ == "__main__":
    main()
