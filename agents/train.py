"""Training from the command line: python -m agents.train --help."""

import dataclasses
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import jax
import tyro
from rich.console import Console

import trap_tube_jax as tt
from agents.config import PRESETS, Config
from agents.parallel import processes
from agents.parallel.sharding import Placement
from agents.runs import compilation_cache
from agents.runs.folder import Run, RunFolder, write_json
from agents.runs.session import Session, Stopped, StopSignals

PROGRAM = "python -m agents.train"
# Settings that do not shape what has been trained so far.
EXTENDABLE = ("iterations", "stop_when_solved")


@dataclasses.dataclass(frozen=True)
class Selection:
    """What names a run, and so decides the defaults of all other settings.

    Attributes:
      preset: the named settings to start from.
      env: the task set to train on, by id or short name; the same as --env-id.
      seed: the first seed.
      seeds: how many seeds to train side by side, from --seed on.
      name: the run's folder within --out; <preset>-<task set>-<seed> if absent.
      out: the folder of all runs.
      resume: continue the run of this name where its newest checkpoint ends; its settings
        are the defaults then, and only --iterations and --stop-when-solved may change.
    """

    preset: Annotated[str, tyro.conf.arg(metavar="|".join(PRESETS))] = "fast"
    env: str | None = None
    seed: int = 0
    seeds: int = 1
    name: str | None = None
    out: Path = Path("runs")
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False


@dataclasses.dataclass(frozen=True)
class Options(processes.Job, Selection):
    """Trains an agent, evaluates it on all task sets and leaves everything in a folder.

    Ctrl-C stops after the current iteration and saves; a second one stops at once.
    --resume then continues to the same result as if nothing had happened.

    Attributes:
      devices: how many devices share the episodes and seeds, or `all` there are; one if
        absent, and with several processes all of theirs.
      checkpoint_every: iterations from one checkpoint to the next.
      keep: how many checkpoints to keep, the newest.
      no_cache: compile everything anew, instead of keeping compiled programs in
        ~/.cache/trap_tube_jax from one time to the next.
      config: the settings of training.
    """

    devices: int | Literal["all"] | None = None
    checkpoint_every: int = 10
    keep: int = 3
    no_cache: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    config: Annotated[Config, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Config)

    def __post_init__(self) -> None:
        """Refuses impossible numbers."""
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
      SystemExit: it is refused, or training was stopped.
    """
    try:
        find_job(arguments).join()
        console = Console(quiet=not processes.is_first())
        options, folder, run = processes.from_first(lambda: set_up(arguments))
        if not options.no_cache:
            compilation_cache.enable()
        session = Session(
            folder,
            run,
            console,
            checkpoint_every=options.checkpoint_every,
            keep=options.keep,
            placement=Placement.of(options.devices, run.config, run.seeds),
        )
        # More iterations, once the run has been taken up.
        processes.from_first(lambda: write_json(folder.config, run.to_dict()))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    except KeyboardInterrupt:
        processes.leave(128 + signal.SIGINT)
    except jax.errors.JaxRuntimeError as error:
        end_without_peers(error, "Begin again with the same command.")

    def tell() -> None:
        where = f"Stopped at iteration {session.saved}. {how_to_resume(folder)}"
        console.print(where, soft_wrap=True)

    stop = StopSignals(lambda: console.print("Finishing this iteration; again to abandon it."))
    try:
        session.train(stop)
        session.finish()
    except Stopped as stopped:
        tell()
        raise SystemExit(128 + stopped.signal) from None
    except KeyboardInterrupt:
        tell()
        processes.leave(128 + (stop.received or signal.SIGINT))
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        end_without_peers(error, f"Iteration {session.saved} is saved. {how_to_resume(folder)}")
    finally:
        session.close()


def find_job(arguments: Sequence[str]) -> processes.Job:
    """How the command line finds other processes.

    Raises:
      ValueError: the description is incomplete or contradicts itself.
    """
    job, _ = tyro.cli(
        processes.Job, args=arguments, prog=PROGRAM, add_help=False, return_unknown_args=True
    )
    return job


def set_up(arguments: Sequence[str]) -> tuple[Options, RunFolder, Run]:
    """Checks a command line as a whole, then makes or opens its run.

    Raises:
      ValueError: something is not allowed.
      OSError: the folder cannot be made.
    """
    options, stored = parse(arguments)
    Placement.of(options.devices, options.config, options.seeds)
    return options, *open_run(options, stored)


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


def parse(arguments: Sequence[str]) -> tuple[Options, Run | None]:
    """The options of a command line, and the stored run that --resume names.

    Raises:
      ValueError: a value is not allowed, or contradicts the stored run.
    """
    selection, _ = tyro.cli(
        Selection, args=arguments, prog=PROGRAM, add_help=False, return_unknown_args=True
    )
    overrides = {} if selection.env is None else {"env_id": selection.env}
    config = Config.preset(selection.preset, **overrides)
    stored = None
    defaults = Options(preset=selection.preset, config=config)
    path = run_path(selection, config.env_id)
    if selection.resume:
        _, stored = RunFolder.open(path)
        defaults = Options(
            preset=stored.preset, seed=stored.seed, seeds=stored.seeds, config=stored.config
        )
    options = tyro.cli(
        Options, args=arguments, prog=PROGRAM, default=defaults, config=(tyro.conf.OmitArgPrefixes,)
    )
    _check_env(options, given=selection.env)
    env_id = tt.task_set(options.config.env_id).id
    options = dataclasses.replace(
        options, config=dataclasses.replace(options.config, env_id=env_id)
    )
    if stored is not None:
        _check_same(options, stored)
    else:
        path = run_path(options, options.config.env_id)
    return dataclasses.replace(options, name=path.name), stored


def run_path(selection: Selection, env_id: str) -> Path:
    """The run's folder.

    Raises:
      ValueError: unknown task set, or the name is not that of a folder.
    """
    short = tt.task_set(env_id).short
    last = f"to{selection.seed + selection.seeds - 1}" if selection.seeds > 1 else ""
    name = selection.name or f"{selection.preset}-{short}-{selection.seed}{last}"
    if Path(name).name != name:
        raise ValueError(f"name must be the name of a folder, without a path, got {name!r}")
    return selection.out / name


def open_run(options: Options, stored: Run | None) -> tuple[RunFolder, Run]:
    """The folder of the run, made or resumed.

    Raises:
      ValueError: there is a run already, and it is not to be resumed.
    """
    run = Run(options.config, options.preset, options.seed, options.seeds)
    path = run_path(options, options.config.env_id)
    if stored is None:
        return RunFolder.create(path, run), run
    return RunFolder(path), run


def how_to_resume(folder: RunFolder) -> str:
    """What to type to continue."""
    out = "" if folder.path.parent == Path("runs") else f" --out {folder.path.parent}"
    return f"Continue with: {PROGRAM} --resume --name {folder.path.name}{out}"


def _check_env(options: Options, given: str | None) -> None:
    wanted = tt.task_set(options.config.env_id).id
    if given is not None and tt.task_set(given).id != wanted:
        raise ValueError(f"--env {given} contradicts --env-id {options.config.env_id}; give one")


def _check_same(options: Options, stored: Run) -> None:
    """Refuses to continue a run with other settings than it has."""
    now = {
        "preset": options.preset,
        "seed": options.seed,
        "seeds": options.seeds,
        **options.config.to_dict(),
    }
    before = {
        "preset": stored.preset,
        "seed": stored.seed,
        "seeds": stored.seeds,
        **stored.config.to_dict(),
    }
    for name, value in before.items():
        if name not in EXTENDABLE and now[name] != value:
            raise ValueError(
                f"the run has {name}={value}, not {now[name]}; --resume may change "
                f"{' and '.join(EXTENDABLE)} only"
            )


if __name__ == "__main__":
    main()
