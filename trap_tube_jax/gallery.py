"""Draws a contact sheet of the eight task sets, and solved episodes as GIFs.

On the command line: `python -m trap_tube_jax.gallery --output figures --gifs`.
"""

import argparse
import pathlib
from collections.abc import Sequence

import jax
import numpy as np

from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.registry import make
from trap_tube_jax.rendering import episode_frames, save_gif
from trap_tube_jax.solver import solve
from trap_tube_jax.state import State

SOLVED_SETS = ("base", "p", "st", "sy", "pstsy")


def solved_episode(state: State, cell_size: int = 20) -> np.ndarray:
    """Draws a shortest solution with the agent's hand, u8[L + 1, 12 s, 12 s, 3].

    Args:
      state: one unbatched state.
      cell_size: s >= 1, pixels per cell and side.

    Raises:
      ValueError: the task has no solution.
    """
    plan = solve(state)
    if not plan.solvable:
        raise ValueError("the task has no solution, so there is no episode to show")
    return episode_frames(state, plan.actions, cell_size)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    parser = argparse.ArgumentParser(
        prog="python -m trap_tube_jax.gallery",
        description="Draw the eight task sets.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--output", type=pathlib.Path, default=".", help="folder of gallery.png and the GIFs")
    add("--tasks", type=int, default=4, help="different tasks per set, at least 2")
    add("--cell-size", type=int, default=16, help="pixels per cell and side, at least 8")
    add("--seed", type=int, default=0, help="seed of the tasks, 0 to 2**32 - 1")
    add("--gifs", action="store_true", help="solve a task each of base, p, st, sy and pstsy")
    options = parser.parse_args(arguments)
    with plain_errors():
        for path in _save(options):
            print(path)


def _save(options: argparse.Namespace) -> list[pathlib.Path]:
    """Writes the pictures and returns their paths."""
    from trap_tube_jax.contact_sheet import contact_sheet  # noqa: PLC0415  needs pillow

    folder = options.output
    folder.mkdir(parents=True, exist_ok=True)
    sheet = contact_sheet(tasks=options.tasks, cell_size=options.cell_size, seed=options.seed)
    sheet.save(folder / "gallery.png", optimize=True)
    paths = [folder / "gallery.png"]
    for short in SOLVED_SETS if options.gifs else ():
        state, _ = make(short).reset(jax.random.key(options.seed))
        paths.append(folder / f"solved_{short}.gif")
        save_gif(solved_episode(state), paths[-1], fps=4)
    return paths


if __name__ == "__main__":
    main()
