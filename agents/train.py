"""Training from the command line: python -m agents.train --help."""

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path

import jax

import trap_tube_jax as tt
from agents.command_line import option, parse_all
from agents.config import Config
from agents.parallel import processes
from agents.parallel.devices import split_cpu
from agents.runs import compilation
from agents.runs.console import CommandConsole
from agents.runs.folder import RunFolder, check_name
from agents.runs.loading import load, short_name
from agents.runs.metrics import read_rows
from agents.runs.run import DeviceOptions, Run, RunOptions
from agents.runs.session import train_run
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.interruptions import exit_when_stopped, run_command

PROGRAM = "python -m agents.train"
DEFAULT_PRESET = "fast"


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains an agent, evaluates it on all task sets and writes a folder of results.

    Ctrl-C saves and stops; --resume continues to the same result.

    Attributes:
      preset: initial settings (fast, best or paper), by default fast.
      finetune: agent to fine-tune, with its settings. A run's folder, a file of parameters or a
        shipped agent; schedules begin anew.
      seed: seed of all draws. agents.sweep trains several.
      name: the run's folder within --out, by default <preset or agent>-<task set>-<seed>.
      out: the folder of all runs.
      resume: folder of a run to continue with its options. Of its settings and evaluation, only
        --iterations, --max-transitions and --stop-when-solved may change.
      imports: module to import first. It may register curiosities, encoders and task sets.
      distributed: joins the processes of a Slurm, Open MPI, Kubernetes or Cloud TPU job, or of the
        job at HOST:PORT PROCESSES NUMBER.
    """

    preset: str | None = option(None, "run")
    finetune: str | None = option(None, "run")
    seed: int = option(0, "run")
    name: str | None = option(None, "run")
    out: Path = option(Path("runs"), "run")
    resume: Path | None = option(None, "run")
    imports: tuple[str, ...] = option((), "run", append=True, flags=("--import",))
    distributed: tuple[str, ...] | None = option(None, "devices and hosts", may_be_empty=True)


@plain_errors()
def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    # Some options decide how the others are read.
    first, devices = parse_all([Options, DeviceOptions], arguments, PROGRAM, partly=True)
    start_devices(first, devices)
    options, run, run_options = parse(first, arguments)
    folder = RunFolder(run_path(options, run))
    if options.resume is None:
        folder.check_free()
        processes.max_over_processes(None)  # no process writes before all have checked
    train(folder, run, run_options)


def start_devices(first: Options, devices: DeviceOptions) -> None:
    """Splits the CPU and joins the other processes, before modules of --import start JAX."""
    stored = None if first.resume is None else RunFolder(first.resume).devices()
    split_cpu(devices.devices or stored)
    processes.join(first.distributed)


def parse(first: Options, arguments: Sequence[str] | None) -> tuple[Options, Run, RunOptions]:
    """Reads a command line; preset, agent to fine-tune or stored run have the defaults."""
    new = Options()
    if first.resume is None:
        config = Config.preset(first.preset or DEFAULT_PRESET)
        if first.finetune is not None:
            if first.preset is not None:
                raise ValueError("--finetune begins with the agent's settings; leave out --preset")
            config = load(first.finetune, imports=first.imports).config
        run = Run(config, finetune=first.finetune)
        run_options = RunOptions()
        defaults = new
    else:
        fixed = ("name", "out", "preset", "finetune")
        if any(getattr(first, name) != getattr(new, name) for name in fixed):
            raise ValueError(
                "--resume continues a run as it is; leave out --name, --out, --preset and "
                "--finetune"
            )
        run, run_options = RunFolder(first.resume).read(first.imports)
        defaults = Options(seed=run.seed)
    options, config, run_options = parse_all(
        [defaults, run.config, run_options], arguments, PROGRAM
    )
    run = dataclasses.replace(
        run,
        config=config,
        seed=options.seed,
        imports=tuple(dict.fromkeys((*run.imports, *options.imports))),
        algorithm=run.algorithm if first.resume else "",  # "": named after the settings
    )
    return options, run, run_options


def train(folder: RunFolder, run: Run, run_options: RunOptions) -> None:
    """Trains a run, or continues it, and prints its results, or how to continue if it stops."""
    is_first = jax.process_index() == 0
    console = CommandConsole(quiet=not is_first, highlight=False)
    compilation.enable_cache()
    try:
        with exit_when_stopped(lambda: resume_hint(folder, run) if is_first else ""):
            train_run(folder.path, run, run_options, console=console)
            for line in summary(folder, run):
                console.out(line)
    except OSError as error:
        hint = f". {resume_hint(folder, run)}" if folder.config.is_file() else ""
        raise OSError(f"{error}{hint}") from error


def run_path(options: Options, run: Run) -> Path:
    """Returns the run's folder; ValueError if its name is a path."""
    if options.resume is not None:
        return options.resume
    short = tt.task_set(run.config.env_id).short
    origin = options.preset or DEFAULT_PRESET
    if run.finetune is not None:
        origin = short_name(run.finetune)
    name = f"{origin}-{short}-{run.seed}" if options.name is None else options.name
    check_name(name)
    return options.out / name


def summary(folder: RunFolder, run: Run) -> list[str]:
    """Summarises a finished run, one fact per line."""
    lines = []
    config = run.config
    train_set = tt.task_set(config.env_id).label
    threshold = config.stop_when_solved or 1.0
    rows = read_rows(folder.metrics)
    solving = rows.query("validation_success >= @threshold")["episodes"]
    if len(solving):
        share = "" if threshold == 1 else f"{100 * threshold:g} % of "
        more = "; --stop-when-solved 0 trains on" if config.stop_when_solved else ""
        lines.append(f"First solved {share}{train_set} after {solving.min():,} episodes{more}.")
    done = max(rows["iteration"], default=0)
    limit = config.max_transitions
    if limit is not None and done < config.iterations and rows["transitions"].max() >= limit:
        lines.append(
            f"Stopped by --max-transitions {limit} after {done} of {config.iterations} iterations."
        )
    if folder.page.exists():
        lines.append(f"Report with curves and episodes to step through: {folder.page}")
    if config.stop_when_solved and len(solving):
        more = "python -m agents.train --preset best"
        lines.append(f"Next, learn all transfers in 40 to 130 minutes: {more}")
    elif not config.has_schedule and config.max_transitions is None:
        again = resume_command(folder, run)
        lines.append(f"Train longer: {again} --iterations {2 * config.iterations}")
    return lines


def resume_hint(folder: RunFolder, run: Run) -> str:
    """Returns the command that resumes an interrupted run, in a sentence."""
    if not folder.config.is_file():
        return f"{folder.path} holds no run to continue."
    return f"Continue with: {resume_command(folder, run)}"


def resume_command(folder: RunFolder, run: Run) -> str:
    """Returns the command that resumes a run."""
    imports = [word for name in run.imports for word in ("--import", name)]
    return shlex.join([*PROGRAM.split(), "--resume", str(folder.path), *imports])


if __name__ == "__main__":
    run_command(main)
