"""A run on one page of HTML that needs no network: settings, curves, scores, episodes to step."""

import base64
import html
import io
import json
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluation, Evaluator, play_greedily
from agents.config import Config
from agents.ppo.learner import TrainState, make_train
from agents.runs.compilation import compiled
from agents.runs.report import FEW_LAYOUTS, evaluation_table
from trap_tube_jax import solver
from trap_tube_jax.objects import BOARD_SIZE, DIRECTION_NAMES, NO_DIRECTION
from trap_tube_jax.rendering import episode_frames
from trap_tube_jax.scoring.scores import Score
from trap_tube_jax.scoring.tasks import label
from trap_tube_jax.state import State

CELL_SIZE = 16  # pixels
MAX_PICTURES = 600  # of all episodes, of at most two kilobytes each

EPISODES_OF_A_SET = 2  # the first solved one and the first unsolved one

# From the state of training, M tasks and which of them count, bool[M], to the intrinsic reward
# f32[M, T] of its greedy play.
Pay = Callable[[TrainState, State, np.ndarray], jax.Array]

PAGE = Path(__file__).with_name("report.html")  # its $names are filled in


def save(
    path: Path,
    *,
    title: str,
    sentences: Sequence[str],
    settings: Mapping[str, Any],
    scores: Mapping[str, Sequence[Score]],
    curves: Path,
    evaluator: Evaluator,
    played: Mapping[str, Evaluation],
    pay: Callable[[State, np.ndarray], jax.Array],
) -> None:
    """Writes the page.

    Args:
      path: the file to write.
      title: the head of the page.
      sentences: what the run shows.
      settings: by name.
      scores: the scores of every policy, by its name.
      curves: the PNG of the learning curves.
      evaluator: what played.
      played: what it returned of one policy, whose episodes are shown.
      pay: from tasks, and which of them count, to the intrinsic reward of this policy's play;
        see `compile_pay`.
    """
    episodes, pictures = _episodes(evaluator, played, pay)
    data = json.dumps({"episodes": episodes, "pictures": pictures})
    page = string.Template(PAGE.read_text(encoding="utf-8")).substitute(
        title=html.escape(title),
        sentences="\n".join(f"<p>{html.escape(line)}</p>" for line in sentences if line),
        scores="\n".join(_score_table(name, each) for name, each in scores.items()),
        few_layouts=html.escape(FEW_LAYOUTS),
        curves=base64.b64encode(curves.read_bytes()).decode(),
        settings=_table(("setting", "value"), settings.items()),
        data=data.replace("</", "<\\/"),
    )
    path.write_text(page, encoding="utf-8")


def _score_table(name: str, scores: Sequence[Score]) -> str:
    table = evaluation_table(scores, name)
    return _table((name, *table.heads[1:]), table.rows)


def _table(heads: Sequence[Any], rows: Iterable[Sequence[Any]]) -> str:
    def line(cells: Sequence[Any], tag: str) -> str:
        inner = "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for cell in cells)
        return f"<tr>{inner}</tr>"

    return "\n".join(["<table>", line(heads, "th"), *(line(row, "td") for row in rows), "</table>"])


def compile_pay(config: Config, state: TrainState, evaluator: Evaluator) -> Pay:
    """What the curiosity pays for greedy play of tasks, were these all that is played next.

    Args:
      config: the settings.
      state: the state of training of one seed, or its shapes.
      evaluator: that of the page, for the number of tasks and the step limit.
    """
    learner = make_train(config)
    longest = max(evaluator.limits.values())
    env = tt.Environment(base=tt.base_state(config.num_features), max_steps=longest)

    def paid(state: TrainState, tasks: State, counts: jax.Array) -> jax.Array:
        _, trajectory = play_greedily(learner.agent, state.params, env, tasks)
        episodes = trajectory.episodes
        trajectory = trajectory._replace(
            episodes=episodes._replace(mask=episodes.mask * counts[None])
        )
        return learner.intrinsic_reward(state, trajectory)[0].swapaxes(0, 1)

    shown = EPISODES_OF_A_SET * len(evaluator.tasks)
    tasks = jax.tree.map(lambda x: jax.ShapeDtypeStruct((shown, *x.shape), x.dtype), env.base)
    return compiled(jax.jit(paid).lower(state, tasks, np.ones(shown, bool)), config)


def _episodes(
    evaluator: Evaluator,
    played: Mapping[str, Evaluation],
    pay: Callable[[State, np.ndarray], jax.Array],
) -> tuple[list[dict[str, Any]], list[str]]:
    """The first solved and the first unsolved episode of each set, and their pictures as PNG.

    Sets are left out once there are too many pictures.
    """
    shown = [
        (name, int(found[0]))
        for name, outcome in played.items()
        for solved in (True, False)
        if len(found := np.flatnonzero(np.asarray(outcome.solved) == solved))
    ]
    states = [jax.tree.map(lambda x, i=i: x[i], evaluator.tasks[name]) for name, i in shown]
    plans = solver.solve_batch(jax.tree.map(lambda *x: np.stack(x), *states)).actions
    # Always as many, so that what plays them is compiled in time.
    places = np.arange(EPISODES_OF_A_SET * len(evaluator.tasks))
    padded = [states[place] if place < len(states) else states[0] for place in places]
    tasks = jax.tree.map(lambda *x: np.stack(x), *padded)
    novelty = np.asarray(pay(tasks, places < len(states)))
    episodes: list[dict[str, Any]] = []
    pictures: dict[bytes, int] = {}
    for (name, index), state, plan, paid in zip(shown, states, plans, novelty, strict=False):
        if len(pictures) <= MAX_PICTURES:
            episodes.append(_episode(name, index, played[name], state, plan, paid, pictures))
    return episodes, [base64.b64encode(_png(picture)).decode() for picture in pictures]


def _episode(
    name: str,
    index: int,
    outcome: Evaluation,
    state: State,
    plan: np.ndarray,
    novelty: np.ndarray,
    pictures: dict[bytes, int],
) -> dict[str, Any]:
    """One episode, the plan i32[L, 2] for its task, and the intrinsic reward f32[T] it earned.

    Returns:
      `title`, what to call it; `solved`, whether it was; `frames` and `actions` as `_replay`
      gives them; `values`, f32 of each step, what the network expects; `novelty`, f32 of each
      step, the intrinsic reward before scaling; `plan`, the replay of the oracle's shortest plan,
      without actions if there is none.
    """
    solved, length = bool(outcome.solved[index]), int(outcome.length[index])
    # Without a direction nothing changes: all episodes and plans are as long, and compile as one.
    longest = max(outcome.action.shape[1], len(plan))
    taken, ideal = np.full((2, longest, 2), NO_DIRECTION)
    taken[:length] = outcome.action[index, :length]
    ideal[: len(plan)] = plan
    return {
        "title": f"{label(name)}, task {index}: {'solved' if solved else 'not solved'}",
        "solved": solved,
        **_replay(state, taken, pictures),
        "values": [round(float(value), 4) for value in outcome.value[index, :length]],
        "novelty": [round(float(reward), 4) for reward in novelty[:length]],
        "plan": _replay(state, ideal, pictures),
    }


def _replay(state: State, actions: np.ndarray, pictures: dict[bytes, int]) -> dict[str, Any]:
    """What actions i32[T, 2], padded with -1, do in a task.

    Args:
      state: the task.
      actions: the actions.
      pictures: the number of each picture; those of the replay are added.

    Returns:
      `frames`, the number of a picture before each step and after the last; `actions`, those of
      each step in words.
    """
    taken = actions[(actions >= 0).all(axis=1)]
    frames = episode_frames(state, actions, CELL_SIZE)[: len(taken) + 1]
    return {
        "frames": [pictures.setdefault(frame.tobytes(), len(pictures)) for frame in frames],
        "actions": [
            f"grasp {DIRECTION_NAMES[grasp]}, move {DIRECTION_NAMES[move]}"
            for grasp, move in taken.tolist()
        ],
    }


def _png(pixels: bytes) -> bytes:
    from PIL import Image  # noqa: PLC0415  slow to import

    side = BOARD_SIZE * CELL_SIZE
    file = io.BytesIO()
    Image.frombytes("RGB", (side, side), pixels).quantize(32).save(file, "png")
    return file.getvalue()
