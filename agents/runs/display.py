"""Progress of a run on one line of a terminal, and its results in a few."""

import shlex
import statistics
from collections.abc import Mapping, Sequence
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from scipy.stats import binomtest

import trap_tube_jax as tt
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import FirstSolved, Row
from trap_tube_jax.scoring.tasks import label


class ProgressLine:
    """Shows training: one line that changes on a terminal, else a line per iteration.

    A context manager. Nothing is drawn in the background.
    """

    def __init__(self, console: Console, iterations: int):
        self._console = console
        self._progress = Progress(
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            TextColumn("{task.description}", markup=False),
            TimeRemainingColumn(compact=True),
            console=console,
            auto_refresh=False,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=iterations)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(self, rows: Sequence[Row]) -> None:
        """Shows an iteration, given its rows of metrics; numbers are means over seeds."""
        mean = {name: statistics.fmean(row[name] for row in rows) for name in rows[0]}
        text = (
            f"{mean['episodes']:,.0f} episodes, {mean['success']:.1%} solved, "
            f"{mean['evaluation']:.1%} greedily, "
            f"{len(rows) * mean['transitions_per_second']:,.0f} steps/s"
        )
        done = int(mean["iteration"])
        if self._console.is_terminal:
            self._progress.update(self._task, completed=done, description=text, refresh=True)
        else:
            self._console.print(f"iteration {done}: {text}", soft_wrap=True, highlight=False)


def evaluation_table(rows: Sequence[Row]) -> str:
    """Returns rows of `evaluations.csv` as a table, one line per task set, means over seeds.

    Percentages of one seed have their 95 % Wilson interval. Sets with few layouts have none, but
    the number of layouts solved in more than half of their draws.
    """
    form = "{:<22}{:>7}{:>10}{:>16}{:>10}{:>8}".format
    lines = [form("set", "tasks", "solved %", "95 % interval", "layouts", "steps")]
    for name in dict.fromkeys(row["task_set"] for row in rows):
        own = [row for row in rows if row["task_set"] == name]
        percent = 100 * statistics.fmean(row["solved"] / row["tasks"] for row in own)
        steps = [row["length"] for row in own if row["length"] != ""]
        few = own[0]["layouts"] != ""
        interval = layouts = "–"
        if len(own) == 1 and few:
            layouts = f"{own[0]['layouts']} of {own[0]['layouts_total']}"
        elif len(own) == 1:
            found = binomtest(own[0]["solved"], own[0]["tasks"]).proportion_ci(method="wilson")
            interval = f"{100 * found.low:.1f}–{100 * found.high:.1f}"
        text = f"{statistics.fmean(steps):.1f}" if steps else "–"
        title = label(name) if label(name) == name else f"{label(name)} ({name})"
        lines.append(form(title, own[0]["tasks"], f"{percent:.1f}", interval, layouts, text))
    return "\n".join(lines)


def summary(
    folder: RunFolder, run: Run, tested: Sequence[Row], solved: Mapping[int, FirstSolved]
) -> list[str]:
    """Returns the facts that a run ends with, one a line.

    Args:
      folder: its files.
      run: what was trained.
      tested: its rows of `evaluations.csv` on test tasks.
      solved: when each seed was first solved.
    """
    own = tt.task_set(run.config.env_id)
    percent: dict[str, list[float]] = {}
    for row in tested:
        percent.setdefault(row["task_set"], []).append(100 * row["solved"] / row["tasks"])
    means = {name: statistics.fmean(values) for name, values in percent.items()}
    others = [value for name, value in means.items() if name != own.short]
    count = f" ({len(solved)} of {run.seeds} seeds)" if run.seeds > 1 else ""
    if solved:
        episodes = statistics.fmean(first.episodes for first in solved.values())
        learned = f"Solved {own.label} after {episodes:,.0f} episodes{count}"
    else:
        learned = f"Did not solve {own.label} yet"
    lines = [f"{learned}; {means.get(own.short, 0):.1f} % of its test tasks at the end."]
    if others:
        lines.append(f"Other task sets: {statistics.fmean(others):.1f} % on average.")
    lines.append(f"Report with curves and episodes to step through: {folder.page}")
    if folder.animation.exists():
        lines.append(f"A solved episode: {folder.animation}")
    config = run.config
    if config.stop_when_solved and len(solved) == run.seeds:
        lines.append("Next, learn all transfers: python -m agents.train --preset best")
    elif not config.lr_decay_fraction and not config.intrinsic_coef_init:
        lines.append(f"Train longer: {resume_command(folder)} --iterations {2 * config.iterations}")
    return lines


def resume_command(folder: RunFolder) -> str:
    """Returns the command that continues a run."""
    return f"python -m agents.train --resume {shlex.quote(str(folder.path))}"
