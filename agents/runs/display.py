"""Shows progress on one terminal line."""

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

from agents.runs.metrics import Row


class ProgressLine(Progress):
    """Shows progress: one line that changes on a terminal, else a line per call of `write`.

    A context manager. Nothing is drawn in the background.
    """

    def __init__(self, console: Console, total: float, *columns: ProgressColumn, **options: Any):
        rest = Column(ratio=1, no_wrap=True, overflow="ellipsis")  # alone is truncated
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
