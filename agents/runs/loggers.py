"""Logs metrics to TensorBoard and Weights & Biases."""

import contextlib
import importlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from agents.runs.folder import RunFolder
from agents.runs.metrics import Row, read_rows
from agents.runs.run import Run, RunOptions
from trap_tube_jax.command_line import one_line
from trap_tube_jax.imports import needs_extra

Log = Callable[[Row], Any]


def check_loggers(options: RunOptions) -> None:
    """Checks that the loggers can log, before anything is compiled or written.

    Raises:
      ImportError: a library is missing; the message names the extra to install.
      ValueError: Weights & Biases has no API key and is not offline.
    """
    with needs_extra("logging"):
        for name in ("tensorboard", "wandb"):
            if getattr(options, name):
                importlib.import_module(name)
    if options.wandb:
        import wandb  # noqa: PLC0415  # pyright: ignore

        try:
            wandb.login()  # asks for a key on a terminal
        except wandb.Error as error:
            raise ValueError(
                f"--wandb cannot log: {one_line(error)} WANDB_MODE=offline needs no key."
            ) from error


@contextlib.contextmanager
def open_loggers(path: Path, run: Run, *, tensorboard: bool, wandb: bool) -> Iterator[Log]:
    """Opens loggers in the folder of a run; yields a function that logs a row of metrics.

    A resumed run continues after the last row of metrics.csv, without duplicate iterations.
    """
    folder = RunFolder(path)
    with contextlib.ExitStack() as stack:
        logs: list[Log] = []
        if tensorboard:
            logs.append(stack.enter_context(_open_tensorboard(folder)))
        if wandb:
            logs.append(stack.enter_context(_open_wandb(folder, run)))
        yield lambda row: [log(row) for log in logs]


@contextlib.contextmanager
def _open_tensorboard(folder: RunFolder) -> Iterator[Log]:
    """Writes all rows of metrics.csv again: TensorBoard shows older files beside newer ones."""
    from tensorboard.summary import Writer  # noqa: PLC0415  # pyright: ignore

    for path in folder.tensorboard.glob("events.out.tfevents.*"):
        path.unlink()
    with contextlib.closing(Writer(str(folder.tensorboard))) as writer:

        def log(row: Row) -> None:
            for name, value in row.items():
                writer.add_scalar(name, value, row["iteration"])

        for row in read_rows(folder.metrics).to_dict("records"):
            log(row)
        yield log


@contextlib.contextmanager
def _open_wandb(folder: RunFolder, run: Run) -> Iterator[Log]:
    """Continues the run of the newest W&B folder, or begins one."""
    import wandb  # noqa: PLC0415  # pyright: ignore

    try:
        logged = wandb.init(
            project="trap-tube-jax",
            group=folder.title,
            config=run.to_dict(),
            dir=folder.path,
            id=_wandb_id(folder),
            resume="allow",
            reinit="create_new",  # beside those of other seeds, and of the caller
        )
    except wandb.Error as error:
        raise ValueError(
            f"--wandb cannot log: {one_line(error)} WANDB_MODE=offline needs no network."
        ) from error
    with logged:
        yield lambda row: logged.log(row, row["iteration"])


def _wandb_id(folder: RunFolder) -> str | None:
    """Returns the id in the name of the newest folder, such as run-20260131_235959-ab12cd34."""
    pattern = re.compile(r"(?:offline-)?run-(\d{8}_\d{6})-(.+)")
    names = [pattern.fullmatch(path.name) for path in folder.path.glob("wandb/*")]
    return max((match.groups() for match in names if match), default=(None, None))[1]
