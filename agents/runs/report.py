"""How a run is shown: the live table, tables of results, learning curves, a GIF."""

import dataclasses
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table as RichTable
from rich.text import Text

from agents.acting.evaluation import Evaluation, Evaluator
from agents.acting.policy import Policy
from agents.runs.metrics import FirstSolved, Row
from agents.runs.table import NOTHING, STYLE, Table, number
from trap_tube_jax.rendering import episode_frames, save_gif
from trap_tube_jax.scoring.scores import Score

LIVE_ROWS = 10
LIVE_WIDTH = 10  # characters of a column; a narrow terminal shows the first columns only
CELL_SIZE = 24  # pixels
FEW_LAYOUTS = (
    "Sets without {P} have one or five layouts, whose colours may vary: for these the table "
    "counts the layouts solved in more than half of their draws, and gives no interval."
)


# Of the live table: head, metric, and the format of its mean over seeds.
LIVE_COLUMNS = (
    ("iter", "iteration", ",.0f"),
    ("episodes", "episodes", ",.0f"),
    ("steps/s", "transitions_per_second", ",.0f"),
    ("solved%", "success", ".2%"),
    ("greedy%", "evaluation", ".2%"),
    ("intrins.", "intrinsic_reward", ".3g"),
    ("policy", "policy_loss", ".3g"),
    ("value", "value_loss", ".3g"),
    ("forward", "forward_loss", ".3g"),
    ("inverse", "inverse_loss", ".3g"),
    ("entropy", "entropy", ".3g"),
)


class LiveReport:
    """Shows training as it goes: a live table on a terminal, else a line per iteration.

    A context manager. Numbers are means over the seeds that still train;
    steps/s is their sum.
    """

    def __init__(self, console: Console, total_iterations: int, num_seeds: int):
        self._console = console
        self._total = total_iterations
        self._num_seeds = num_seeds
        self._rows: deque[Row] = deque(maxlen=LIVE_ROWS)
        self._durations: deque[float] = deque(maxlen=LIVE_ROWS)
        self._shown_at = time.perf_counter()
        self._live = None
        if console.is_terminal:
            self._live = Live(console=console, auto_refresh=False, transient=False)

    def __enter__(self) -> Self:
        self._shown_at = time.perf_counter()
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, rows: Sequence[Row], num_solved: int, *, ready_at: float = 0.0) -> None:
        """Shows an iteration.

        Args:
          rows: its rows of metrics, one per seed that trained.
          num_solved: seeds solved so far.
          ready_at: when all was compiled, by `time.perf_counter`; the time until then does not
            count in what is left.
        """
        now = time.perf_counter()
        self._durations.append(now - max(self._shown_at, ready_at))
        self._shown_at = now
        mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
        mean["transitions_per_second"] *= len(rows)
        self._rows.append(mean)
        if self._live is None:
            self._print_line(mean, num_solved)
        else:
            self._live.update(Group(self._table(), self._status(mean, num_solved)), refresh=True)

    def _columns(self) -> list[tuple[str, str, str]]:
        return [column for column in LIVE_COLUMNS if column[1] in self._rows[0]]

    def _print_line(self, mean: Row, num_solved: int) -> None:
        columns = self._columns()
        if len(self._rows) == 1:
            self._line([head for head, _, _ in columns])
        self._line(_cells(mean, columns), self._left(num_solved))

    def _line(self, cells: Sequence[str], rest: str = "") -> None:
        text = " ".join(f"{cell:>9}" for cell in cells)
        self._console.print(Text(f"{text}  {rest}".rstrip()), soft_wrap=True)

    def _table(self) -> RichTable:
        columns = self._columns()[: self._console.width // LIVE_WIDTH]
        table = RichTable(**STYLE)
        for head, _, _ in columns:
            table.add_column(head, justify="right", no_wrap=True)
        for row in self._rows:
            table.add_row(*_cells(row, columns))
        return table

    def _status(self, mean: Row, num_solved: int) -> Text:
        done = int(mean["iteration"])
        return Text(f"iteration {done} of {self._total}, {self._left(num_solved)}")

    def _left(self, num_solved: int) -> str:
        remaining = max(0, self._total - int(self._rows[-1]["iteration"]))
        seconds = remaining * float(np.mean(self._durations))
        text = f"{duration(seconds)} left at most"
        return text if self._num_seeds == 1 else f"{num_solved}/{self._num_seeds} solved, {text}"


def _cells(mean: Row, columns: Sequence[tuple[str, str, str]]) -> list[str]:
    """The cells of a row. Percentages have no sign, which is in the head."""
    return [format(mean[metric], form).removesuffix("%") for _, metric, form in columns]


def duration(seconds: float) -> str:
    """A number of seconds for people, as in 1:02:03 or 4:05."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def evaluation_table(scores: Sequence[Score], title: str) -> Table:
    """The scores of a policy, one set per row."""
    rows = [
        (
            _set_name(score),
            str(score.tasks),
            f"{score.percent:.1f}",
            NOTHING if score.layouts is None else str(score.layouts),
            NOTHING if score.interval is None else "{:.1f}–{:.1f}".format(*score.interval),
            number(score.mean_steps, ".1f"),
        )
        for score in scores
    ]
    heads = ("set", "tasks", "solved %", "layouts solved", "95 % interval", "steps")
    return Table(f"Greedy evaluation: {title}", heads, tuple(rows))


def optimality_table(scores: Sequence[Score], title: str) -> Table:
    """How the play of a policy compares with shortest plans, where that was searched for."""
    rows = [
        (
            _set_name(score),
            number(found.percent_of_solvable, ".1f"),
            number(found.mean, ".3f"),
            number(found.worst, ".3f"),
        )
        for score in scores
        if (found := score.optimality) is not None
    ]
    heads = ("set", "of solvable %", "optimality", "worst")
    return Table(f"Shortest plan / steps taken, where solved: {title}", heads, tuple(rows))


def _set_name(score: Score) -> str:
    return f"{score.label} ({score.set})" if score.label != score.set else score.label


def summary_table(solved: Mapping[int, FirstSolved | None], env: str) -> Table:
    """When each seed was first solved."""
    rows: list[tuple[str, ...]] = []
    for seed, first in solved.items():
        cells = [NOTHING] * 4
        if first is not None:
            counts = (first.iteration, first.episodes, first.transitions)
            cells = [*(f"{count:,}" for count in counts), duration(first.seconds)]
        rows.append((str(seed), *cells))
    heads = ("seed", "iteration", "episodes", "transitions", "training time")
    return Table(f"First solved on {env}", heads, tuple(rows))


PANELS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("success", ("success",), "share of training episodes solved"),
    ("greedy evaluation", ("evaluation",), "share of tasks solved"),
    ("episode length", ("episode_length",), "steps"),
    ("intrinsic reward", ("intrinsic_reward",), "mean per step, before scaling"),
    ("policy and value loss", ("policy_loss", "value_loss"), "weighted loss"),
    ("curiosity losses", ("forward_loss", "inverse_loss"), "weighted loss"),
    ("entropy", ("entropy",), "nats, grasp + move"),
    ("gradient norm", ("gradient_norm",), "before clipping"),
)


def save_curves(rows: Sequence[Row], path: Path, title: str) -> None:
    """Draws the learning curves over episodes as PNG, a line per seed.

    Args:
      rows: all rows of metrics, at least one.
      path: the file to write.
      title: over all panels.
    """
    panels = [
        (name, [metric for metric in metrics if metric in rows[0]], unit)
        for name, metrics, unit in PANELS
        if name != "intrinsic reward" or any(row.get("intrinsic_reward") for row in rows)
    ]
    panels = [panel for panel in panels if panel[1]]
    figure, axes = over_episodes([name for name, _, _ in panels], 2, (5.5, 2.6), title)
    for axis, (_, metrics, unit) in zip(axes, panels, strict=True):
        _draw_panel(axis, rows, metrics)
        axis.set_ylabel(unit, fontsize="small")
        if unit.startswith("share"):
            axis.set_ylim(-0.03, 1.03)
    figure.savefig(path, format="png", dpi=110)


def over_episodes(
    names: Sequence[str],
    columns: int,
    size: tuple[float, float],
    title: str,
    *,
    sharey: bool = False,
) -> tuple[Any, list[Any]]:
    """A figure with a panel over episodes for each name, of `size` in inches, and the panels."""
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import
    from matplotlib.ticker import EngFormatter, MaxNLocator  # noqa: PLC0415

    height = -(-len(names) // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * height + 0.6), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(height, columns, sharex=True, sharey=sharey, squeeze=False).flat
    for axis in axes[len(names) :]:
        axis.remove()
    panels = list(axes[: len(names)])
    for axis, name in zip(panels, names, strict=True):
        axis.set_title(name, loc="left", fontsize="medium")
        axis.grid(alpha=0.3)
    for axis in panels[-columns:]:  # the lowest of each column
        axis.set_xlabel("episodes")
        axis.tick_params(labelbottom=True)
        axis.xaxis.set_major_locator(MaxNLocator(5))
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    return figure, panels


def _draw_panel(axis: Any, rows: Sequence[Row], metrics: Sequence[str]) -> None:
    seeds = sorted({row["seed"] for row in rows})
    for color, metric in zip(("C0", "C1"), metrics, strict=False):
        for seed in seeds:
            of_seed = [row for row in rows if row["seed"] == seed]
            label = metric.replace("_", " ") if seed == seeds[0] else None
            axis.plot(
                [row["episodes"] for row in of_seed],
                [row[metric] for row in of_seed],
                color=color,
                linewidth=1.2,
                alpha=1.0 if len(seeds) == 1 else 0.6,
                marker="." if len(of_seed) < 20 else None,
                label=label,
            )
    if len(metrics) > 1:
        axis.legend(fontsize="small")


def save_first_solved(
    path: Path,
    evaluator: Evaluator,
    played: Iterable[Mapping[str, Evaluation]],
    prefer: str,
) -> str | None:
    """Writes a GIF of the first solved episode of the first policy that solves one.

    Args:
      path: the file to write.
      evaluator: what played.
      played: what it returned, of one policy after the other.
      prefer: the set to take the episode from if one of its is solved.

    Returns:
      The name of its set, or None if no episode is solved: then nothing is written.
    """
    for outcomes in played:
        for name in sorted(outcomes, key=lambda name: name != prefer):
            outcome = outcomes[name]
            if np.any(outcome.solved):
                index = int(np.argmax(outcome.solved))
                actions = np.asarray(outcome.action[index, : outcome.length[index]])
                state = jax.tree.map(lambda x, i=index: x[i], evaluator.tasks[name])
                save_gif(episode_frames(state, actions, CELL_SIZE), path, fps=4)
                return name
    return None


def results_json(
    policies: Sequence[Policy], results: Mapping[str, Sequence[Score]]
) -> list[dict[str, Any]]:
    """The scores of every policy as plain values."""
    return [
        {
            "policy": policy.name,
            "iteration": policy.iteration,
            "sets": [dataclasses.asdict(score) for score in results[policy.name]],
        }
        for policy in policies
    ]
