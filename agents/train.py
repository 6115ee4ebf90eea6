"""Training from the command line: python -m agents.train --help."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
from rich.console import Console

import trap_tube_jax as tt
from agents.command_line import option, parse_all
from agents.config import Config
from agents.parallel import processes
from agents.parallel.devices import split_cpu
from agents.runs import compilation, display
from agents.runs.folder import RunFolder, check_name
from agents.runs.run import DeviceOptions, Run, RunOptions
from agents.runs.session import train_run
from agents.runs.stopping import Stopped, exit_code
from trap_tube_jax.command_line import plain_errors

PROGRAM = "python -m agents.train"


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains an agent, evaluates it on all task sets and writes a folder of results.

    Ctrl-C stops after the current iteration and saves; --resume continues to the same result.
    A second Ctrl-C stops at once.

    Attributes:
      preset: initial settings (fast, best or paper).
      seed: seed of all draws. agents.sweep trains several.
      name: the run's folder within --out, by default <preset>-<task set>-<seed>.
      out: the folder of all runs.
      resume: folder of a run to continue with its options. Of its settings only --iterations,
        --max-transitions and --stop-when-solved may change.
      imports: module to import first. It may register curiosities, encoders and task sets.
      distributed: trains with the other processes of a Slurm, Open MPI, Kubernetes or Cloud TPU
        job, or else of a job at HOST:PORT PROCESSES NUMBER.
    """

    preset: str = option("fast", "run")
    seed: int = option(0, "run")
    name: str | None = option(None, "run")
    out: Path = option(Path("runs"), "run")
    resume: Path | None = option(None, "run")
    imports: tuple[str, ...] = option((), "run", append=True, flags=("--import",))
    distributed: tuple[str, ...] | None = option(None, "devices and hosts")


@plain_errors()
def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    start_devices(arguments)
    train(*parse(arguments))


def start_devices(arguments: Sequence[str] | None) -> None:
    """Splits the CPU and joins the other processes, before modules of --import start JAX."""
    options, run_options = parse_all([Options, DeviceOptions], arguments, PROGRAM, partly=True)
    stored = None if options.resume is None else RunFolder(options.resume).devices()
    split_cpu(run_options.devices or stored)
    processes.join(options.distributed)


def parse(arguments: Sequence[str] | None) -> tuple[Options, Run, RunOptions]:
    """Reads a command line and, with --resume, the stored run."""
    # The preset, or the stored run, decides the defaults of all other options.
    (first,) = parse_all([Options], arguments, PROGRAM, partly=True)
    defaults, run, run_options = Options(), Run(Config.preset(first.preset)), RunOptions()
    if first.resume is not None:
        if (first.name, first.preset) != (defaults.name, defaults.preset):
            raise ValueError("--resume continues a run as it is; leave out --name and --preset")
        run, run_options = RunFolder(first.resume).read(first.imports)
        defaults = Options(seed=run.seed)
    options, config, run_options = parse_all(
        [defaults, run.config, run_options], arguments, PROGRAM
    )
    imports = tuple(dict.fromkeys((*run.imports, *options.imports)))
    given = {"config": config, "seed": options.seed, "imports": imports}
    if first.resume is None:
        given["algorithm"] = ""  # named after the settings given
    return options, dataclasses.replace(run, **given), run_options


def train(options: Options, run: Run, run_options: RunOptions) -> None:
    """Trains a run, or continues it, and prints its results, or how to continue if it stops."""
    folder = RunFolder(run_path(options, run))
    if options.resume is None:
        folder.check_free()
        processes.max_over_processes(None)  # no process writes before all have checked
    console = Console(quiet=jax.process_index() > 0, highlight=False)
    compilation.enable_cache()
    try:
        scores = train_run(folder.path, run, run_options, console=console)
    except (Stopped, KeyboardInterrupt) as stopped:
        console.out(f"Stopped. {display.resume_hint(folder, run)}")
        raise SystemExit(exit_code(stopped)) from None
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OSError(f"{error}. {display.resume_hint(folder, run)}") from error
    for line in ([scores] if scores else []) + display.summary(folder, run):
        console.out(line)


def run_path(options: Options, run: Run) -> Path:
    """Returns the run's folder; ValueError if its name is a path."""
    if options.resume is not None:
        return options.resume
    short = tt.task_set(run.config.env_id).short
    name = options.name or f"{options.preset}-{short}-{run.seed}"
    check_name(name)
    return options.out / name


if __name__ == "__main__":
    main()
