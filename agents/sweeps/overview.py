"""Progress of all runs of a grid: one line that changes on a terminal, else a line a minute."""

import contextlib
import datetime
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from rich.console import Console

from agents.runs.display import ProgressLine
from agents.runs.folder import RunFolder
from agents.runs.run import Run

REFRESH_SECONDS = 5  # between two readings of the runs' files
LOG_SECONDS = 60  # between two lines where there is no terminal


class Overview(ProgressLine):
    """Shows the share of all iterations that are done, and the time left.

    Reads the runs' files.
    """

    def __init__(self, console: Console, runs: Mapping[Path, Run]):
        super().__init__(console, 1, transient=True)
        self.runs = runs
        self.began = self.shown = time.monotonic()
        self.share_before = self._share()

    def __enter__(self) -> Self:
        """Shows the first line."""
        super().__enter__()
        self._show()
        return self

    def show(self) -> None:
        """Shows the progress if that is due; to be called every second."""
        wait = REFRESH_SECONDS if self.console.is_terminal else LOG_SECONDS
        if time.monotonic() - self.shown >= wait:
            self._show()

    def _show(self) -> None:
        self.shown = time.monotonic()
        share = self._share()
        text = f"{share:.0%} of {len(self.runs)} run(s), {self._time_left(share)}"
        self.write(share, text)

    def _share(self) -> float:
        """Returns the mean share of the iterations that runs may take, which is from 0 to 1."""
        shares = [_rows(path) / run.config.iterations for path, run in self.runs.items()]
        return sum(shares) / len(shares)

    def _time_left(self, share: float) -> str:
        trained = share - self.share_before
        if trained <= 0:
            return "time left is known after the first iterations"
        seconds = (self.shown - self.began) * (1 - share) / trained
        return f"at most {datetime.timedelta(seconds=round(seconds))} left"


def _rows(path: Path) -> int:
    """Counts the iterations in a run's file, which a worker may be writing."""
    metrics = RunFolder(path).metrics
    with contextlib.suppress(OSError):
        return max(0, metrics.read_bytes().count(b"\n") - 1)
    return 0
