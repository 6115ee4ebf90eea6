"""Metrics to TensorBoard and to Weights & Biases, by their own libraries."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from agents.runs.folder import Run
from agents.runs.metrics import Row
from trap_tube_jax.imports import needs_extra


@contextlib.contextmanager
def open_loggers(
    folder: Path, run: Run, *, tensorboard: bool, wandb: bool
) -> Iterator[Callable[[Row], None]]:
    """Opens the loggers asked for, in a run's folder; yields a function that logs a row.

    Names are those of `metrics.csv`. A missing library raises an ImportError that names its extra.
    """
    with contextlib.ExitStack() as stack:
        logs: list[Callable[[dict[str, float], int], Any]] = []
        if tensorboard:
            with needs_extra("logging"):
                from tensorboard.summary import Writer  # noqa: PLC0415  # pyright: ignore
            writer = Writer(str(folder / "tensorboard"))
            stack.callback(writer.close)
            logs.append(
                lambda values, step: [writer.add_scalar(k, v, step) for k, v in values.items()]
            )
        if wandb:
            with needs_extra("logging"):
                import wandb as wandb_library  # noqa: PLC0415  # pyright: ignore
            logged = stack.enter_context(
                wandb_library.init(
                    project="trap-tube-jax", group=folder.name, config=run.to_dict(), dir=folder
                )
            )
            logs.append(logged.log)

        def log(row: Row) -> None:
            values = {name: value for name, value in row.items() if name != "iteration"}
            for each in logs:
                each(values, row["iteration"])

        yield log
