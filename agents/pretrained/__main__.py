"""Exports a trained agent to a file of parameters: python -m agents.pretrained --help."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from agents import pretrained
from agents.acting.policy import Policy
from agents.runs.folder import RunFolder, check_name
from agents.runs.loading import load_policy
from trap_tube_jax.command_line import Flag, plain_errors

PROGRAM = "python -m agents.pretrained"


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes the parameters of a run to a file that needs no run.

    Within the package, the default, `agents.evaluate --pretrained NAME` finds it.

    Attributes:
      run: the run's folder.
      name: the file's name, without its ending.
      seed: which seed of the run; its first if absent.
      iteration: the checkpoint to take; the newest if absent.
      best: take the parameters of the best evaluation of an experiment's run instead.
      half: round to float16, for half the size.
      out: the folder to write to.
      force: replace a file of that name.
    """

    run: Annotated[Path, tyro.conf.Positional]
    name: str
    seed: int | None = None
    iteration: int | None = None
    best: Flag = False
    half: Flag = False
    out: Path = Path(pretrained.__file__).parent
    force: Flag = False


@dataclasses.dataclass(frozen=True)
class List:
    """Lists the parameters that are shipped."""


Command = (
    Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[List, tyro.conf.subcommand("list")]
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    command = tyro.cli(Command, args=arguments, prog=PROGRAM)  # pyright: ignore[reportArgumentType, reportCallIssue]
    with plain_errors():
        if isinstance(command, Export):
            path = export(command)
            print(f"{path}: {path.stat().st_size:,} bytes")
        else:
            for name in pretrained.names():
                policy = pretrained.load_shipped(name)
                print(f"{name}: {policy.config.env_id}, iteration {policy.iteration}")


def export(options: Export) -> Path:
    """Writes the file that the options ask for, and returns its place.

    Raises:
      ValueError: there is no such run, seed or checkpoint, or the name is not one, or taken.
    """
    check_name(options.name, "file")
    path = options.out / f"{options.name}{pretrained.SUFFIX}"
    if path.exists() and not options.force:
        raise ValueError(f"{path} exists; give --force to replace it, or another --name")
    pretrained.save(path, find_policy(options), half=options.half)
    return path


def find_policy(options: Export) -> Policy:
    """The policy that the options name.

    Raises:
      ValueError: there is no such run, seed or checkpoint.
    """
    if not options.best:
        return load_policy(options.run, options.seed, options.iteration)
    if options.iteration is not None:
        raise ValueError("--best and --iteration name different parameters; give one")
    folder, run = RunFolder.open(options.run)
    seed = run.seed if options.seed is None else options.seed
    kept = list(folder.kept_best(seed).values())
    if not kept:
        raise ValueError(
            f"{options.run} keeps no best parameters of seed {seed}: only the runs of "
            "agents.experiments do; without --best the newest checkpoint is exported"
        )
    return pretrained.load(kept[-1])


if __name__ == "__main__":
    main()
