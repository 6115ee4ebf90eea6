"""Draws tasks of the eight task sets: python -m trap_tube_jax.gallery --help."""

import argparse
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from trap_tube_jax.checks import check_integer, check_seed, expand
from trap_tube_jax.command_line import path_argument, plain_errors
from trap_tube_jax.figures import default_style
from trap_tube_jax.imports import needs_extra
from trap_tube_jax.interruptions import run_command
from trap_tube_jax.objects import NUM_OBJECTS, OBJECT_NAMES
from trap_tube_jax.observation import visible_objects
from trap_tube_jax.registry import PAPER_TASK_SETS, TaskSet, make, task_set
from trap_tube_jax.rendering import render, used_window
from trap_tube_jax.state import base_state, take
from trap_tube_jax.transfers import (
    Transfer,
    perceptual,
    structural,
    symbolic,
    transfer_name,
)

CHANGES: dict[Transfer, str] = {
    perceptual: "layout",
    structural: "colours",
    symbolic: "tool",
}
DRAWS = 64  # tasks of which the first distinct ones are shown
CELL_SIZE = 16  # pixels
SIGN_SIZE = 48  # pixels


@default_style()
def save_gallery(
    path: str | os.PathLike[str],
    ids: Sequence[str] = tuple(entry.id for entry in PAPER_TASK_SETS),
    *,
    tasks: int = 4,
    seed: int = 0,
) -> None:
    """Writes a PNG with some tasks of every set, and a legend of the objects.

    Args:
      path: the file to write.
      ids: the task sets, at least one; the paper's eight if absent.
      tasks: maximum number of tasks per set, 2 to 64: the first distinct ones of 64 draws.
      seed: seed of the tasks, 0 to 2**32 - 1.

    Raises:
      ValueError: an argument is invalid; the message says what is allowed.
      ImportError: matplotlib is not installed.
    """
    tasks = check_integer("tasks", tasks, 2, DRAWS)
    seed = check_seed(seed)
    if isinstance(ids, str) or not ids:
        raise ValueError(f"ids must name at least one task set, as in ('base', 'p'), got {ids!r}")
    entries = [task_set(name) for name in ids]
    with needs_extra("pictures"):
        from matplotlib.figure import Figure  # noqa: PLC0415  importing stays light

    rows = -(-len(entries) // 2)
    figure = Figure(figsize=(2.8 * tasks + 1, 1.8 * rows + 0.7), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.8 * rows, 0.7))
    sets, legend = parts
    for panel, entry in zip(sets.subfigures(rows, 2, squeeze=False).flat, entries, strict=False):
        panel.suptitle(_title(entry), x=0.02, ha="left")
        _draw(panel.subplots(1, tasks), _distinct_tasks(entry, tasks, seed))
    axes = legend.subplots(1, NUM_OBJECTS)
    _draw(axes, _signs())
    for axis, name in zip(axes, OBJECT_NAMES, strict=True):
        axis.set_title(name, size="medium")
    figure.savefig(expand(path), format="png", dpi=160)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    parser = argparse.ArgumentParser(
        prog="python -m trap_tube_jax.gallery",
        description="Draws tasks of the eight task sets.",
    )
    add = parser.add_argument
    add("--output", type=path_argument, default=".", help="folder of gallery.png [%(default)s]")
    add("--tasks", type=int, default=4, help="distinct tasks per set, 2 to 64 [%(default)s]")
    add("--seed", type=int, default=0, help="seed of the tasks, 0 to 2**32 - 1 [%(default)s]")
    options = parser.parse_args(arguments)
    with plain_errors():
        options.output.mkdir(parents=True, exist_ok=True)
        save_gallery(options.output / "gallery.png", tasks=options.tasks, seed=options.seed)
        print(options.output / "gallery.png")


def _title(entry: TaskSet) -> str:
    changes = ", ".join(
        CHANGES.get(transfer, transfer_name(transfer)) for transfer in entry.transfers
    )
    return f"{entry.label}: {changes}" if changes else entry.label


def _draw(axes: np.ndarray, pictures: np.ndarray) -> None:
    for axis in axes:
        axis.set_axis_off()
    for axis, picture in zip(axes, pictures, strict=False):
        axis.imshow(picture, interpolation="nearest")


def _distinct_tasks(entry: TaskSet, tasks: int, seed: int) -> np.ndarray:
    """Draws the first K <= `tasks` distinct tasks among `DRAWS`, u8[K, height, width, 3].

    Leaves out rows and columns without objects.
    """
    keys = jax.random.split(jax.random.key(seed), DRAWS)
    states, _ = jax.jit(jax.vmap(make(entry.id).reset))(keys)
    pictures = np.asarray(jax.vmap(lambda state: render(state, CELL_SIZE))(states))
    first: dict[bytes, int] = {}
    for index, picture in enumerate(pictures):
        first.setdefault(picture.tobytes(), index)
    shown = np.array(list(first.values())[:tasks])
    rows, columns = used_window(take(states, shown), CELL_SIZE)
    return pictures[shown, rows, columns]


def _signs() -> np.ndarray:
    """Cuts the objects out of the base task, u8[8, s, s, 3]."""
    state = base_state()
    cells = np.asarray(render(state, SIGN_SIZE)).reshape(12, SIGN_SIZE, 12, SIGN_SIZE, 3)
    objects = np.asarray(visible_objects(state))
    shown = [np.argwhere(objects == code)[0] for code in range(NUM_OBJECTS)]
    return np.stack([cells[row, :, column] for row, column in shown])


if __name__ == "__main__":
    run_command(main)
