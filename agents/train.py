"""Training from the command line: python -m agents.train --help."""

import dataclasses
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import jax
import tyro
from rich.console import Console

import trap_tube_jax as tt
from agents.command_line import Flag, Imports
from agents.config import PRESETS, Config
from agents.parallel import processes
from agents.parallel.cores import become_devices
from agents.parallel.sharding import Placement
from agents.runs import compilation
from agents.runs.folder import Run, RunFolder, check_name
from agents.runs.session import Session
from agents.runs.stopping import AGAIN, Stopped, StopSignals
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import import_modules

PROGRAM = "python -m agents.train"


@dataclasses.dataclass(frozen=True)
class Selection(processes.Job):
    """What is read first: how processes meet, and which run decides all other defaults.

    Attributes:
      preset: the named settings to start from.
      imports: modules of your own, for the curiosities, encoders and task sets that they
        register; read first, before all other options.
      env: the task set to train on, by id or short name; read first, before all other options.
      seed: the first seed.
      seeds: how many seeds to train side by side, from --seed on.
      name: the run's folder within --out; <preset>-<task set>-<seed> if absent.
      out: the folder of all runs.
      resume: continue the run of this name where its newest checkpoint ends; its settings
        are the defaults then, and only --iterations, --max-transitions and
        --stop-when-solved may change.
      devices: how many devices share the episodes and seeds, or `all` there are. On a CPU a
        device is a core, and up to 4 share them unless said otherwise. Of other devices one is
        used, or all where there are several processes.
    """

    preset: Annotated[str, tyro.conf.arg(metavar="|".join(PRESETS))] = "fast"
    imports: Annotated[Imports, tyro.conf.arg(aliases=("--imports",))] = ()
    env: Annotated[str | None, tyro.conf.arg(aliases=("--env-id",))] = None
    seed: int = 0
    seeds: int = 1
    name: str | None = None
    out: Path = Path("runs")
    resume: Flag = False
    devices: int | Literal["all"] | None = None


class Settings(Config):
    """`Config`, of which no option gives what `Selection` gives."""

    env_id: Annotated[str, tyro.conf.Suppress]


@dataclasses.dataclass(frozen=True)
class Options(Selection):
    """Trains an agent, evaluates it on all task sets and leaves everything in a folder.

    Ctrl-C stops after the current iteration and saves; a second one stops at once.
    --resume then continues to the same result as if nothing had happened. Traced and compiled
    programs are kept in ~/.cache/trap_tube_jax; with JAX_ENABLE_COMPILATION_CACHE=0 all are made
    anew.

    Attributes:
      checkpoint_every: iterations from one checkpoint to the next.
      keep: how many checkpoints to keep, the newest.
      config: the settings of training.
    """

    checkpoint_every: int = 10
    keep: int = 3
    config: Annotated[Config, tyro.conf.arg(name="", constructor=Settings)] = dataclasses.field(
        default_factory=Config
    )

    def __post_init__(self) -> None:
        """Checks the numbers."""
        super().__post_init__()
        for name in ("checkpoint_every", "keep"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be >= 1, got {getattr(self, name)}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        train(arguments)
    except Exception:
        if processes.count() == 1:
            raise
        traceback.print_exc()
        processes.leave(1)


def train(arguments: Sequence[str]) -> None:
    """Trains as a command line says.

    Raises:
      SystemExit: the command line is invalid, or training was stopped.
    """
    try:
        with plain_errors():
            session = start(arguments)
    except KeyboardInterrupt:
        processes.leave(128 + signal.SIGINT)
    except jax.errors.JaxRuntimeError as error:
        end_without_peers(error, "Begin again with the same command.")

    console = session.console
    resume = f"Continue with: {session.resume_command}"
    stop = StopSignals(lambda: console.print(f"Finishing this iteration; {AGAIN}."))
    try:
        session.train(stop, then_finish=True)
        session.finish()
    except (Stopped, KeyboardInterrupt) as stopped:
        console.print(f"Stopped at iteration {session.saved}. {resume}", soft_wrap=True)
        if isinstance(stopped, Stopped):
            stop.end_process()  # the exit may have to wait for what compiles in the background
            raise SystemExit(128 + stopped.signal) from None
        processes.leave(128 + (stop.received or signal.SIGINT))
    except Exception as error:
        if processes.count() == 1 and not session.saved:
            session.close()
            session.folder.remove_if_new()  # else the same command would be refused
        if isinstance(error, jax.errors.JaxRuntimeError | ValueError):
            end_without_peers(error, f"Iteration {session.saved} is saved. {resume}")
        raise
    finally:
        session.close()


def start(arguments: Sequence[str]) -> Session:
    """The session of a command line, once all processes have met.

    Raises:
      ValueError: something is not allowed.
      OSError: the run's folder cannot be made.
    """
    selection = select(arguments)
    if selection.is_alone:
        become_devices(selection.devices)
    selection.join()
    console = Console(quiet=not processes.is_first())
    options, folder, run = processes.from_first(lambda: open_run(selection, arguments))
    try:
        return take_up(options, folder, run, console)
    except Exception:
        if processes.is_first():
            folder.remove_if_new()  # else the same command would be refused
        raise


def take_up(options: Options, folder: RunFolder, run: Run, console: Console) -> Session:
    """The session of a run whose folder is there.

    Raises:
      ValueError: the run cannot be trained or continued.
    """
    compilation.enable_cache()
    session = Session(
        folder,
        run,
        console,
        checkpoint_every=options.checkpoint_every,
        keep=options.keep,
        placement=Placement.of(options.devices, run.config, run.seeds),
        options=() if options.devices is None else ("--devices", str(options.devices)),
    )
    # More iterations, once the run has been taken up.
    processes.from_first(lambda: folder.note(run))
    return session


def select(arguments: Sequence[str]) -> Selection:
    """The part of a command line that decides the defaults of the rest.

    Raises:
      ValueError: it is incomplete or contradicts itself.
    """
    selection, _ = tyro.cli(
        Selection, args=arguments, prog=PROGRAM, add_help=False, return_unknown_args=True
    )
    return selection


def open_run(selection: Selection, arguments: Sequence[str]) -> tuple[Options, RunFolder, Run]:
    """Checks a command line as a whole, then makes or opens its run.

    Raises:
      ValueError: a value is not allowed, contradicts the stored run, or there is a run
        already that is not to be resumed.
      OSError: the folder cannot be made.
    """
    stored, options = parse(selection, arguments)
    config = options.config
    run = Run(config, options.preset, options.seed, options.seeds)
    Placement.of(options.devices, config, options.seeds)
    path = run_path(options, config.env_id)
    if stored is None:
        return options, RunFolder.create(path, run), run
    run.check_continues(stored)
    return options, RunFolder(path), run


def parse(selection: Selection, arguments: Sequence[str]) -> tuple[Run | None, Options]:
    """The stored run that --resume names, and all options.

    Raises:
      ValueError: a value is not allowed.
    """
    given: dict[str, Any] = {} if selection.env is None else {"env_id": selection.env}
    import_modules(selection.imports)
    config = Config.preset(selection.preset, **given)
    stored, defaults = None, Options(preset=selection.preset, config=config)
    path = run_path(selection, config.env_id)
    if selection.resume:
        _, stored = RunFolder.open(path)
        own_id = tt.task_set(stored.config.env_id).id
        if selection.env is not None and tt.task_set(selection.env).id != own_id:
            raise ValueError(
                f"the run in {path} is of {own_id}, not of --env {selection.env}; leave that out, "
                "or begin a new run"
            )
        defaults = Options(
            preset=stored.preset,
            seed=stored.seed,
            seeds=stored.seeds,
            config=stored.config,
        )
    options = tyro.cli(
        Options, args=arguments, prog=PROGRAM, default=defaults, config=(tyro.conf.OmitArgPrefixes,)
    )
    env_id = tt.task_set(options.config.env_id).id
    config = Config.from_dict({**options.config.to_dict(), "env_id": env_id})
    name = path.name if stored else run_path(options, env_id).name
    return stored, dataclasses.replace(options, config=config, name=name)


def run_path(selection: Selection, env_id: str) -> Path:
    """The run's folder.

    Raises:
      ValueError: unknown task set, or the name is not that of a folder.
    """
    short = tt.task_set(env_id).short
    last = f"to{selection.seed + selection.seeds - 1}" if selection.seeds > 1 else ""
    name = selection.name or f"{selection.preset}-{short}-{selection.seed}{last}"
    check_name(name)
    return selection.out / name


def end_without_peers(error: Exception, advice: str) -> NoReturn:
    """Ends one of several processes after an error; one alone raises the error.

    The computations of a process end with one of JAX's errors where another process is gone.
    """
    if processes.count() == 1:
        raise error
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    print(
        f"error: training has ended here, likely because another process did ({reason}). {advice}",
        file=sys.stderr,
    )
    processes.leave(1)


if __name__ == "__main__":
    main()
