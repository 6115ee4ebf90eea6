"""The results of a run for a reader: learning curves, a GIF, and a page with all of it.

The page is one HTML file that needs no network: settings, scores, curves, and episodes to step
through next to the shortest plan.
"""

import base64
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
from agents.files import write_bytes
from agents.runs.evaluator import Evaluator
from agents.runs.folder import RunFolder
from agents.runs.metrics import Frame, read_rows
from agents.runs.run import Run
from trap_tube_jax import solver
from trap_tube_jax.objects import DIRECTION_NAMES, NO_DIRECTION
from trap_tube_jax.rendering import episode_frames, save_gif
from trap_tube_jax.scoring.tasks import label
from trap_tube_jax.state import State, take

CELL_SIZE = 16  # pixels of the page's boards
GIF_CELL_SIZE = 24
PAGE = Path(__file__).with_name("report.html")  # its $names are filled in
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00")  # colour-blind safe

PANELS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("tasks solved", "fraction", ("success", "validation_success")),
    ("episode length", "steps", ("episode_length",)),
    ("intrinsic reward", "mean per step, unscaled", ("intrinsic_reward",)),
    ("losses", "weighted", ("policy_loss", "value_loss", "forward_loss", "inverse_loss")),
    ("entropy", "nats, grasp + move", ("entropy",)),
    ("gradient norm", "before clipping", ("gradient_norm",)),
)

# Outcomes of greedy play by task set.
Played = Mapping[str, Evaluation]


def write(folder: RunFolder, run: Run, evaluator: Evaluator, played: Played) -> None:
    """Writes curves, GIF and page of a run, from an evaluator and its outcomes `played`."""
    save_curves(read_rows(folder.metrics), folder.curves, folder.path.name)
    folder.animation.unlink(missing_ok=True)
    own = tt.task_set(run.config.env_id).short
    save_first_solved(folder.animation, evaluator, played, own)
    episodes = json.dumps(_episodes(evaluator, played))
    page = string.Template(PAGE.read_text(encoding="utf-8")).substitute(
        title=html.escape(folder.path.name),
        scores=evaluator.scores(played),
        curves=base64.b64encode(folder.curves.read_bytes()).decode(),
        settings=html.escape(json.dumps(run.to_dict(), indent=1)),
        episodes=episodes.replace("</", "<\\/"),
    )
    write_bytes(folder.page, page.encode())


def save_curves(rows: Frame, path: Path, title: str) -> None:
    """Draws learning curves over episodes as PNG."""
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    panels = [
        (name, unit, found)
        for name, unit, metrics in PANELS
        if (found := [metric for metric in metrics if metric in rows])
    ]
    figure = Figure(figsize=(10, 2.6 * math.ceil(len(panels) / 2) + 0.5), layout="constrained")
    figure.suptitle(title, parse_math=False)
    for place, (name, unit, metrics) in enumerate(panels, 1):
        axis = figure.add_subplot(math.ceil(len(panels) / 2), 2, place)
        axis.set(ylabel=unit, xlabel="episodes")
        axis.set_title(name, loc="left")
        axis.grid(alpha=0.3)
        for color, metric in zip(COLORS, metrics, strict=False):
            style = {"color": color, "linewidth": 1.2, "marker": "." if len(rows) < 20 else None}
            axis.plot(rows["episodes"], rows[metric], label=metric.replace("_", " "), **style)
        if len(metrics) > 1:
            axis.legend(fontsize="small")
    figure.savefig(path, format="png", dpi=100)


def save_first_solved(path: Path, evaluator: Evaluator, played: Played, prefer: str) -> str | None:
    """Writes a GIF of the first solved episode.

    Returns the episode's task set, `prefer` if possible; None, and no file, if none is solved.
    """
    for name in sorted(played, key=lambda name: name != prefer):
        outcome = played[name]
        if np.any(outcome.solved):
            index = int(np.argmax(outcome.solved))
            actions = np.asarray(outcome.action[index, : outcome.length[index]])
            state = take(evaluator.tasks[name], index)
            save_gif(episode_frames(state, actions, GIF_CELL_SIZE), path, fps=4)
            return name
    return None


def _episodes(evaluator: Evaluator, played: Played) -> list[dict[str, Any]]:
    """Returns the first solved and the first unsolved episode of each set.

    They hold `title`, `solved`, the replays `agent` and `plan` (see `_replay`), and `values`, the
    network's of each step.
    """
    shown = [
        (name, int(found[0]))
        for name, outcome in played.items()
        for solved in (True, False)
        if len(found := np.flatnonzero(np.asarray(outcome.solved) == solved))
    ]
    states = [take(evaluator.tasks[name], index) for name, index in shown]
    plans = solver.solve_batch(jax.tree.map(lambda *x: np.stack(x), *states)).actions
    episodes = []
    for state, shortest, (name, index) in zip(states, plans, shown, strict=True):
        outcome = played[name]
        solved, length = bool(outcome.solved[index]), int(outcome.length[index])
        # Padded to one length, so that all replays share a compiled program.
        longest = max(outcome.action.shape[1], len(shortest))
        actions, plan = np.full((2, longest, 2), NO_DIRECTION)
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


def _replay(state: State, actions: np.ndarray) -> dict[str, Any]:
    """Replays actions i32[T, 2], padded with -1.

    Returns `frames`, the board before each step and after the last as PNG in base64, and
    `actions`, those of each step in words.
    """
    taken = actions[(actions >= 0).all(axis=1)]
    frames = episode_frames(state, actions, CELL_SIZE)[: len(taken) + 1]
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
