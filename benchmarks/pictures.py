"""Draws the pictures of README.md and other pages: python -m benchmarks.pictures --help."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import agents
import trap_tube_jax as tt
from agents.runs.drawing import COLORS, default_style, make_panels
from agents.sweeps import tables
from benchmarks.task_pictures import draw_distances, draw_gallery
from trap_tube_jax.command_line import path_argument, plain_errors
from trap_tube_jax.interruptions import run_command
from trap_tube_jax.scoring.tasks import label
from trap_tube_jax.state import take

RESULTS = Path(__file__).parent / "results"
FIGURES = RESULTS / "figures"
DPI = 200  # twice the pixels of a page that shows 830
CELL = 40  # pixels of a cell before scaling
# Okabe and Ito's colour-blind-safe palette, by object code.
PALETTE = jnp.array(
    [
        (221, 221, 221),  # ground: grey
        (213, 94, 0),  # trap: vermilion
        (230, 159, 0),  # exit: orange
        (86, 180, 233),  # tube1: sky blue
        (86, 180, 233),  # tube2
        (204, 121, 167),  # food: reddish purple
        (0, 158, 115),  # tool: bluish green
        (0, 114, 178),  # agent: blue
    ],
    jnp.uint8,
)
# By object: its cell on the board after two steps, and where its name is written, in cells.
NAMES = {
    "tool (a stick)": ((4, 2), (2.2, 1.8)),
    "food": ((5, 5), (2.2, 5.2)),
    "exit": ((5.5, 7), (4.5, 10.0)),
    "trap": ((6, 4), (9.2, 4.4)),
    "tube": ((7, 6), (9.2, 7.0)),
    "hand": ((7.5, 2), (6.5, 0.4)),
    "agent": ((8, 2), (9.8, 1.6)),
}
STEPS = {  # of the shortest plan
    0: "walk to the tool",
    1: "grasp the tool",
    4: "carry it to the tube",
    6: "push the food",
    8: "let go of the tool",
    11: "reach the food",
}
ROWS = (  # of the figure of Table 2
    "preset best",
    "PPO + ICM, ours",
    "PPO + ICM, published",
    "PPO, ours",
    "PPO, published",
)
GIFS = {  # by file: a shipped agent, a task set and the number of its evaluation task
    "solved_base": ("fast-base", "base", 0),
    "solved_sy": ("best-pstsy", "sy", 0),
    "solved_pst": ("best-pstsy", "pst", 0),
}
SHOWN = slice(2 * CELL, 11 * CELL), slice(0, 10 * CELL)  # of the board, in the six steps


def draw_board() -> Figure:
    """Draws the base task with the names of its objects, and its shortest plan in six steps."""
    state = tt.base_state().replace(palette=PALETTE)
    plan = tt.solve(state)
    frames = tt.episode_frames(state, plan.actions[: plan.length], CELL)
    figure = Figure(figsize=(8.3, 3.6), layout="constrained")
    parts: Any = figure.subfigures(1, 2, width_ratios=(3.4, 4.9))
    large, steps = parts
    axis = large.subplots()
    _show(axis, frames[2])
    for name, (cell, text) in NAMES.items():
        at, to = ((np.array(cells)[::-1] + 0.5) * CELL for cells in (cell, text))
        arrow = {"arrowstyle": "-", "color": "black", "linewidth": 1.2}
        box = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "black"}
        axis.annotate(name, at, to, ha="center", arrowprops=arrow, bbox=box)
    for axis, (step, caption) in zip(steps.subplots(2, 3).flat, STEPS.items(), strict=True):
        _show(axis, frames[step][SHOWN])
        axis.set_xlabel(f"step {step}: {caption}", fontsize=8)
    return figure


def draw_symbolic() -> Figure:
    """Draws the five tasks of {Sy}: with signs, as `render` does, and as the agent sees them."""
    base = tt.base_state().replace(palette=PALETTE)
    keys = jax.random.split(jax.random.key(0), 64)
    states = jax.vmap(tt.symbolic, in_axes=(0, None))(keys, base)
    pictures = np.asarray(jax.vmap(lambda state: tt.render(state, CELL))(states))
    _, first = np.unique(pictures.reshape(len(keys), -1), axis=0, return_index=True)
    figure = Figure(figsize=(8.3, 3.5), layout="constrained")
    rows: Any = figure.subplots(2, 5)
    for (shown, seen), index in zip(rows.T, sorted(first), strict=True):
        _show(shown, pictures[index])
        _show(seen, np.asarray(tt.render(jax.tree.map(lambda x, i=index: x[i], states), 1)))
    for axis, title in zip(rows[:, 0], ("you see", "the agent sees"), strict=True):
        axis.set_ylabel(title)
    return figure


def draw_table_2() -> Figure:
    """Draws success on the sets of Table 2: presets `best` and `paper`, and the paper's agents.

    A filled bar is a mean of five seeds, with points or a standard deviation. An open bar is one
    seed.
    """
    best, ours = (_percent_by_set(name) for name in ("exp2_best", "exp2_paper"))
    seeds = {
        "preset best": best.loc["best"],
        "PPO + ICM, ours": ours.loc["ppo+icm"],
        "PPO, ours": ours.loc["ppo"],
    }
    published = {
        "PPO + ICM, published": tables.PAPER_SUCCESS["PPO + ICM, paper"],
        "PPO, published": tables.PAPER_SUCCESS["PPO, paper"],
    }
    titles = [label(name) for name in tables.PAPER_SETS]
    figure, axes = make_panels(titles, 4, 1.75, "Trained on {P, St, Sy}")
    for index, (axis, name) in enumerate(zip(axes, tables.PAPER_SETS, strict=True)):
        for agent, table in seeds.items():
            _draw_seeds(axis, ROWS.index(agent), table[name].to_numpy())
        for agent, (means, deviations) in published.items():
            _draw_mean(axis, ROWS.index(agent), means[index], deviations[index])
        axis.set(xlim=(0, 125), xticks=[0, 50, 100], ylim=(len(ROWS) - 0.5, -0.5))
    axes[0].set_yticks(range(len(ROWS)), ROWS)
    figure.supxlabel(
        "test tasks solved, %: mean and five seeds (blue), one seed (open), mean ± SD (grey)",
        fontsize=10,
    )
    return figure


def _percent_by_set(record: str) -> Any:
    """Returns percent solved by algorithm and seed, a column per set."""
    return tables.by_set(tables.reported(pd.read_csv(RESULTS / record / "results.csv")))


def _draw_seeds(axis: Any, row: int, percent: np.ndarray) -> None:
    """Draws a bar for the mean of several seeds with a point per seed, or an open bar for one."""
    if len(percent) > 1:
        axis.barh(row, percent.mean(), color=COLORS[5], height=0.7)
        points = {"color": COLORS[0], "alpha": 0.7, "markersize": 3}
        axis.plot(percent, [row] * len(percent), "o", **points)
    else:
        axis.barh(row, percent[0], fill=False, edgecolor=COLORS[0], height=0.7)
    _name_value(axis, row, percent.mean(), percent.max())


def _draw_mean(axis: Any, row: int, mean: float, deviation: float) -> None:
    axis.barh(row, mean, color="#BBBBBB", height=0.7)
    if mean:
        axis.errorbar(mean, row, xerr=deviation, color="black", lw=1)
    _name_value(axis, row, mean, mean + deviation)


def _name_value(axis: Any, row: int, percent: float, end: float) -> None:
    axis.text(end + 3, row, f"{percent:.0f}", va="center", fontsize="x-small")


def _show(axis: Any, picture: np.ndarray) -> None:
    axis.imshow(picture, interpolation="nearest" if len(picture) < CELL else "antialiased")
    axis.set(xticks=[], yticks=[])


def draw_episode(agent: str, name: str, task: int) -> np.ndarray:
    """Draws the episode that a shipped agent plays, u8[T + 1, 288, 288, 3]."""
    env = tt.make(name)
    policy = agents.load(agent)
    step = jax.jit(env.step)
    act = jax.jit(policy.act)
    first = take(tt.evaluation_tasks(name, task + 1), task)
    state = first
    carry = policy.initial(1)
    actions = []
    while not state.done:
        action, carry = act(tt.observe(state)[None], carry)
        state, _ = step(state, action[0])
        actions.append(action[0])
    return tt.episode_frames(_recolored(first), jnp.stack(actions), 24)


def _recolored(state: tt.State) -> tt.State:
    """Returns a state in colours of `PALETTE`, unless its task drew other colours."""
    is_color = (np.asarray(state.palette)[:, None] == tt.base_palette()).all(axis=-1)
    if not is_color.any(axis=1).all():
        return state
    return state.replace(palette=PALETTE[is_color.argmax(axis=1)])


PICTURES = {  # by file: the figure and its pixels per inch
    "board": (draw_board, DPI),
    "distances": (draw_distances, 100),
    "gallery": (draw_gallery, 160),
    "symbolic": (draw_symbolic, DPI),
    "table2": (draw_table_2, DPI),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.pictures",
        description="Draws the pictures of README.md and other pages.",
    )
    parser.add_argument(
        "--output", type=path_argument, default=FIGURES, help="folder of the pictures"
    )
    options = parser.parse_args(arguments)
    with plain_errors(), default_style():
        options.output.mkdir(parents=True, exist_ok=True)
        for name, (draw, dpi) in PICTURES.items():
            draw().savefig(options.output / f"{name}.png", dpi=dpi)
            print(options.output / f"{name}.png")
        for name, episode in GIFS.items():
            tt.save_gif(draw_episode(*episode), options.output / f"{name}.gif", fps=4)
            print(options.output / f"{name}.gif")


if __name__ == "__main__":
    run_command(main)
