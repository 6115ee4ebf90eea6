"""Metrics to TensorBoard and to Weights & Biases, by their own libraries."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from agents.runs.metrics import Row
from agents.runs.run import Run


@contextlib.contextmanager
def open_loggers(
    folder: Path, run: Run, *, tensorboard: bool, wandb: bool
) -> Iterator[Callable[[Row], Any]]:
    """Opens the loggers asked for, in a run's folder; yields a function that logs a row.

    Names are those of `metrics.csv`.
    """
    with contextlib.ExitStack() as stack:
        logs: list[Callable[[Any, int], Any]] = []
        if tensorboard:
            from tensorboard.summary import Writer  # noqa: PLC0415  # pyright: ignore

            writer = stack.enter_context(contextlib.closing(Writer(str(folder / "tensorboard"))))
            logs.append(
                lambda values, step: [writer.add_scalar(k, v, step) for k, v in values.items()]
            )
        if wandb:
            import wandb as wandb_library  # noqa: PLC0415  # pyright: ignore

            logged = stack.enter_context(
                wandb_library.init(
                    project="trap-tube-jax", group=folder.name, config=run.to_dict(), dir=folder
                )
            )
            logs.append(logged.log)

        yield lambda row: [log(row, row["iteration"]) for log in logs]
