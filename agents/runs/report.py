"""The results of a run for a reader: learning curves, a GIF, and a page with all of it.

The page is one HTML file that needs no network: settings, scores, curves, and episodes to step
through next to the shortest plan.
"""

import base64
import fnmatch
import html
import io
import json
import math
import string
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluation
from agents.files import draft_of, write_bytes
from agents.runs.drawing import COLORS, drawing, to_png
from agents.runs.folder import RunFolder
from agents.runs.metrics import Table, read_rows
from agents.runs.provenance import read_provenance
from agents.runs.run import Run
from trap_tube_jax import solver
from trap_tube_jax._version import __version__
from trap_tube_jax.objects import DIRECTION_NAMES, NO_DIRECTION
from trap_tube_jax.scoring import Suite
from trap_tube_jax.scoring.tasks import label
from trap_tube_jax.state import take

CELL_SIZE = 16  # pixels of the page's boards
GIF_CELL_SIZE = 24
PAGE = Path(__file__).with_name("report.html")  # its $names are filled in

# Titles, units and metrics of the panels of learning curves; a star stands for any text.
PANELS: tuple[tuple[str, str, str], ...] = (
    ("tasks solved", "fraction", "*success"),
    ("episode length", "steps", "episode_length"),
    ("intrinsic reward", "mean per step, unscaled", "intrinsic_reward"),
    ("losses", "weighted", "*_loss"),
    ("entropy", "nats, grasp + move", "entropy"),
    ("gradient norm", "before clipping", "gradient_norm"),
)

# Outcomes of greedy play by task set.
Played = Mapping[str, Evaluation]


def write(folder: RunFolder, run: Run, suite: Suite, played: Played) -> None:
    """Writes curves, GIF and page of a run, from its test tasks and their outcomes `played`.

    A file that cannot be drawn costs one line of warning.
    """
    curves = b""
    with drawing(folder.curves):
        curves = draw_curves(read_rows(folder.metrics), folder.title)
        write_bytes(folder.curves, curves)
    with drawing(folder.animation):
        train_set = tt.task_set(run.config.env_id).short
        folder.animation.unlink(missing_ok=True)  # of an earlier policy
        save_first_solved(folder.animation, suite, played, train_set)
    with drawing(folder.page):
        write_bytes(folder.page, _page(folder, run, suite, played, curves).encode())


def _page(folder: RunFolder, run: Run, suite: Suite, played: Played, curves: bytes) -> str:
    config = run.config
    episodes = json.dumps(_episodes(suite, played))
    return string.Template(PAGE.read_text(encoding="utf-8")).substitute(
        title=html.escape(folder.title),
        about=html.escape(
            f"{run.algorithm} on {tt.task_set(config.env_id).label}, seed {run.seed}. "
            f"{_origin(folder)}"
        ),
        scores=_score_rows(suite.scores(played)),
        curves=base64.b64encode(curves).decode(),
        settings=html.escape(json.dumps(run.to_dict(), indent=1)),
        episodes=episodes.replace("</", "<\\/"),
    )


def _origin(folder: RunFolder) -> str:
    """Returns version, commit and machine of a run in words."""
    words = [f"trap_tube_jax {__version__}"]
    for machine in read_provenance(folder.provenance)[-1:]:
        words += [
            f"commit {machine['commit'] or 'unknown'}",
            f"jax {machine['jax']}",
            f"{machine['cores']} core(s) of {machine['processor']}",
            machine["device"],
        ]
    return ", ".join(words)


def _score_rows(scores: tt.Scores) -> str:
    """Returns the rows of the page's table."""
    rows = []
    for score in scores.sets:
        cells = [
            score.label,
            f"{score.tasks:,}",
            f"{score.percent:.1f}",
            "" if score.interval is None else "{:.1f} – {:.1f}".format(*score.interval),
            "" if score.mean_steps is None else f"{score.mean_steps:.1f}",
            "" if score.layouts is None else str(score.layouts),
        ]
        rows.append("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>")
    return "\n".join(rows)


def draw_curves(rows: Table, title: str) -> bytes:
    """Draws learning curves over episodes as PNG."""
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    panels = [
        (name, unit, found)
        for name, unit, pattern in PANELS
        if (found := fnmatch.filter(rows.columns, pattern))
    ]
    figure = Figure(figsize=(10, 2.6 * math.ceil(len(panels) / 2) + 0.5), layout="constrained")
    figure.suptitle(title, parse_math=False)
    for index, (name, unit, metrics) in enumerate(panels, 1):
        axis = figure.add_subplot(math.ceil(len(panels) / 2), 2, index)
        axis.set(ylabel=unit, xlabel="episodes")
        axis.set_title(name, loc="left")
        axis.grid(alpha=0.3)
        for color, metric in zip(COLORS, metrics, strict=False):
            style = {"color": color, "linewidth": 1.2, "marker": "." if len(rows) < 20 else None}
            axis.plot(rows["episodes"], rows[metric], label=metric.replace("_", " "), **style)
        if len(metrics) > 1:
            axis.legend(fontsize="small")
    return to_png(figure, dpi=100)


def save_first_solved(path: Path, suite: Suite, played: Played, prefer: str) -> str | None:
    """Writes a GIF of the first solved episode, if possible on the task set `prefer`.

    Returns the episode's task set, or None without writing a file if no episode is solved.
    """
    for name in sorted(played, key=lambda name: name != prefer):
        outcome = played[name]
        if np.any(outcome.solved):
            index = int(np.argmax(outcome.solved))
            actions = np.asarray(outcome.action[index, : outcome.length[index]])
            state = take(suite.tasks[name], index)
            with draft_of(path) as draft:
                tt.save_gif(tt.episode_frames(state, actions, GIF_CELL_SIZE), draft, fps=4)
            return name
    return None


def _episodes(suite: Suite, played: Played) -> list[dict[str, Any]]:
    """Returns the first solved and the first unsolved episode of every set.

    An episode holds `title`, `solved`, the replays `agent` and `plan` (see `_replay`), and
    `values`, the network's value of every board.
    """
    shown = [
        (name, int(found[0]))
        for name, outcome in played.items()
        for solved in (True, False)
        if len(found := np.flatnonzero(np.asarray(outcome.solved) == solved))
    ]
    states = [take(suite.tasks[name], index) for name, index in shown]
    plans = solver.solve_batch(jax.tree.map(lambda *x: np.stack(x), *states)).actions
    episodes = []
    for state, shortest, (name, index) in zip(states, plans, shown, strict=True):
        outcome = played[name]
        solved = bool(outcome.solved[index])
        length = int(outcome.length[index])
        # Padded to one length, so that all replays share a compiled program.
        longest = max(outcome.action.shape[1], len(shortest))
        actions = np.full((longest, 2), NO_DIRECTION)
        plan = actions.copy()
        actions[:length] = outcome.action[index, :length]
        plan[: len(shortest)] = shortest
        episodes.append(
            {
                "title": f"{label(name)}, task {index}: {'' if solved else 'not '}solved",
                "solved": solved,
                "agent": _replay(state, actions),
                "plan": _replay(state, plan),
                "values": np.asarray(outcome.value[index, :length], float).round(4).tolist(),
            }
        )
    return episodes


def _replay(state: tt.State, actions: np.ndarray) -> dict[str, Any]:
    """Replays actions i32[T, 2], padded with -1.

    Returns `frames`, the boards before every step and after the last one as PNG in base64, and
    `actions`, the steps in words.
    """
    taken = actions[(actions >= 0).all(axis=1)]
    frames = tt.episode_frames(state, actions, CELL_SIZE)[: len(taken) + 1]
    return {
        "frames": list(map(_png, frames)),
        "actions": [
            f"grasp {DIRECTION_NAMES[grasp]}, move {DIRECTION_NAMES[move]}"
            for grasp, move in taken.tolist()
        ],
    }


def _png(pixels: np.ndarray) -> str:
    from PIL import Image  # noqa: PLC0415  slow to import

    file = io.BytesIO()
    Image.fromarray(pixels).quantize(32).save(file, "png")
    return base64.b64encode(file.getvalue()).decode()
