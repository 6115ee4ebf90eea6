"""Shows a run's progress on one terminal line, and its results on a few lines."""

import shlex
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Column

import trap_tube_jax as tt
from agents.runs.folder import RunFolder
from agents.runs.metrics import Row, read_rows
from agents.runs.run import Run


class ProgressLine(Progress):
    """Shows progress: one line that changes on a terminal, else a line per call of `write`.

    A context manager. Nothing is drawn in the background.
    """

    def __init__(self, console: Console, total: float, *columns: ProgressColumn, **options: Any):
        rest = Column(ratio=1, no_wrap=True, overflow="ellipsis")  # alone is cut off
        super().__init__(
            BarColumn(bar_width=12),
            *columns,
            TextColumn("{task.description}", markup=False, table_column=rest),
            console=console,
            auto_refresh=False,
            expand=True,
            disable=not console.is_terminal,
            **options,
        )
        self.add_task("", total=total)

    def write(self, done: float, text: str, head: str = "") -> None:
        """Shows that `done` of the total is done; `head` begins a line that does not change."""
        if self.console.is_terminal:
            self.update(self.task_ids[0], completed=done, description=text, refresh=True)
        else:
            self.console.out(f"{head}{text}")


class TrainingLine(ProgressLine):
    """Shows the progress of one run."""

    def __init__(self, console: Console, iterations: int):
        columns = (MofNCompleteColumn(), TimeRemainingColumn(compact=True), TextColumn("left,"))
        super().__init__(console, iterations, *columns)
        self.update(self.task_ids[0], description="compiling")
        self.iterations = iterations

    def show(self, row: Row) -> None:
        """Shows an iteration, given its row of metrics."""
        text = (
            f"{row['success']:.1%} solved, {row['validation_success']:.1%} greedily, "
            f"{row['episodes']:,} episodes, {row['transitions_per_second']:,.0f} steps/s"
        )
        head = f"iteration {row['iteration']} of {self.iterations}: "
        self.write(row["iteration"], text, head)


def summary(folder: RunFolder, run: Run) -> list[str]:
    """Summarises a finished run, one fact per line."""
    lines = []
    config = run.config
    train_set = tt.task_set(config.env_id).label
    threshold = config.stop_when_solved or 1.0
    solving = read_rows(folder.metrics).query("validation_success >= @threshold")["episodes"]
    if len(solving):
        share = "" if threshold == 1 else f"{100 * threshold:g} % of "
        more = "; --stop-when-solved 0 trains on" if config.stop_when_solved else ""
        lines.append(f"First solved {share}{train_set} after {solving.min():,} episodes{more}.")
    if folder.page.exists():
        lines.append(f"Report with curves and episodes to step through: {folder.page}")
    has_schedule = config.lr_decay_fraction or config.intrinsic_coef_init
    if config.stop_when_solved and len(solving):
        more = "python -m agents.train --preset best"
        lines.append(f"Next, learn all transfers in 40 minutes: {more}")
    elif not has_schedule and config.max_transitions is None:
        again = resume_command(folder, run)
        lines.append(f"Train longer: {again} --iterations {2 * config.iterations}")
    return lines


def resume_hint(folder: RunFolder, run: Run) -> str:
    """Returns the command that resumes an interrupted run, in a sentence."""
    if not folder.config.is_file():
        return f"{folder.path} holds no run to continue."
    return f"Continue with: {resume_command(folder, run)}"


def resume_command(folder: RunFolder, run: Run) -> str:
    """Returns the command that resumes a run."""
    imports = [word for name in run.imports for word in ("--import", name)]
    return shlex.join(["python", "-m", "agents.train", "--resume", str(folder.path), *imports])
