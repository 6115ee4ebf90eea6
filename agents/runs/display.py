"""Progress of a run on one line of a terminal, and its results in a few."""

import shlex
import statistics
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import trap_tube_jax as tt
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import Row, read_rows
from trap_tube_jax.scoring.scores import Score


class ProgressLine(Progress):
    """Shows training: one line that changes on a terminal, else a line per iteration.

    A context manager. Nothing is drawn in the background.
    """

    def __init__(self, console: Console, iterations: int):
        super().__init__(
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            TextColumn("{task.description}", markup=False),
            TimeRemainingColumn(compact=True),
            console=console,
            auto_refresh=False,
            disable=not console.is_terminal,
        )
        self.add_task("", total=iterations)

    def show(self, rows: Sequence[Row]) -> None:
        """Shows an iteration, given its rows of metrics; numbers are means over seeds."""
        mean = {name: statistics.fmean(row[name] for row in rows) for name in rows[0]}
        text = (
            f"{mean['episodes']:,.0f} episodes, {mean['success']:.1%} solved, "
            f"{mean['evaluation']:.1%} greedily, "
            f"{len(rows) * mean['transitions_per_second']:,.0f} steps/s"
        )
        done = int(mean["iteration"])
        if self.console.is_terminal:
            self.update(self.task_ids[0], completed=done, description=text, refresh=True)
        else:
            say(self.console, f"iteration {done}: {text}")


def say(console: Console, text: str) -> None:
    """Prints text as it is: unwrapped, and without markup."""
    console.print(text, soft_wrap=True, highlight=False, markup=False)


def summary(folder: RunFolder, run: Run, scores: Mapping[int, Sequence[Score]]) -> list[str]:
    """Returns the facts that a run ends with, one a line; scores as `train_run` returns them."""
    own, config, lines = tt.task_set(run.config.env_id), run.config, []
    rows = read_rows(folder.metrics)
    solving = rows[rows["evaluation"] >= (config.stop_when_solved or 1.0)]
    episodes = solving.groupby("seed")["episodes"].min()
    if len(episodes):
        count = f" by {len(episodes)} of {run.seeds} seeds" if run.seeds > 1 else ""
        lines.append(f"First solved {own.label} after {episodes.mean():,.0f} episodes{count}.")
    each = [score for seed in scores.values() for score in seed]
    parts = {
        own.label: [score.percent for score in each if score.set == own.short],
        "other sets": [score.percent for score in each if score.set != own.short],
    }
    means = [f"{statistics.fmean(own):.1f} % of {name}" for name, own in parts.items() if own]
    lines += [f"Solves {', '.join(means)}."] if means else []
    lines.append(f"Report with curves and episodes to step through: {folder.page}")
    if config.stop_when_solved and len(episodes) == run.seeds:
        lines.append("Next, learn all transfers: python -m agents.train --preset best")
    elif not config.lr_decay_fraction and not config.intrinsic_coef_init:
        lines.append(f"Train longer: {resume_command(folder)} --iterations {2 * config.iterations}")
    return lines


def resume_command(folder: RunFolder) -> str:
    """Returns the command that continues a run."""
    return f"python -m agents.train --resume {shlex.quote(str(folder.path))}"
