"""Training from the command line: python -m agents.train --help."""

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

import trap_tube_jax as tt
from agents.command_line import build, option, read
from agents.config import Config
from agents.parallel import processes
from agents.parallel.devices import split_cpu
from agents.runs import compilation
from agents.runs.console import CommandConsole
from agents.runs.folder import RunFolder, check_name
from agents.runs.loading import load, short_name
from agents.runs.metrics import read_rows
from agents.runs.run import Run, RunOptions
from agents.runs.session import train_run
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import import_modules
from trap_tube_jax.interruptions import exit_when_stopped, run_command

PROGRAM = "python -m agents.train"
DEFAULT_PRESET = "fast"


@dataclasses.dataclass(frozen=True)
class Options:
    """Trains an agent, evaluates it on all task sets and writes a folder of results.

    Ctrl-C saves and stops; --resume continues to the same result. Brackets hold the defaults of
    preset fast.

    Attributes:
      preset: initial settings (fast, best or paper) [fast].
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
    values = read([Options, Config.preset(DEFAULT_PRESET), RunOptions()], arguments, PROGRAM)
    options = build(Options, values)
    # Before modules of --import start JAX.
    stored = None if options.resume is None else RunFolder(options.resume).devices()
    split_cpu(values.get("devices") or stored)
    processes.join(options.distributed)
    import_modules(options.imports)
    run, run_options = configure(options, values)
    folder = RunFolder(run_path(options, run))
    if options.resume is None:
        folder.check_free()
        processes.max_over_processes(None)  # no process writes before all have checked
    train(folder, run, run_options)


def configure(options: Options, values: dict[str, Any]) -> tuple[Run, RunOptions]:
    """Returns the run of a command line and its options.

    Those that are not among `values` have the preset's values, or those of the agent to fine-tune
    or of the stored run.

    Raises:
      ValueError: a value is not allowed, or contradicts another one.
    """
    if options.resume is not None:
        if {"name", "out", "preset", "finetune"} & values.keys():
            raise ValueError(
                "--resume continues a run as it is; leave out --name, --out, --preset and "
                "--finetune"
            )
        run, run_options = RunFolder(options.resume).read(options.imports)
    else:
        config = Config.preset(options.preset or DEFAULT_PRESET)
        if options.finetune is not None:
            if options.preset is not None:
                raise ValueError("--finetune begins with the agent's settings; leave out --preset")
            config = load(options.finetune, imports=options.imports).config
        run, run_options = Run(config, finetune=options.finetune), RunOptions()
    run = dataclasses.replace(
        run,
        config=build(run.config, values),
        seed=values.get("seed", run.seed),
        imports=tuple(dict.fromkeys((*run.imports, *options.imports))),
        algorithm=run.algorithm if options.resume else "",  # "": named after the settings
    )
    return run, build(run_options, values)


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
