"""How far a run has come."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from agents.config import Config
from agents.runs.folder import Run
from agents.runs.metrics import FirstSolved, Row, first_solved


class Progress(NamedTuple):
    """What a run has come to, beside the state of training.

    Attributes:
      iteration: iterations done by the seeds that still train.
      seconds: seconds of training, compilation excluded.
      compile_seconds: seconds of compiling the iteration, over all processes.
      solved: for each seed, when it was first solved.
    """

    iteration: int
    seconds: float
    compile_seconds: float
    solved: tuple[FirstSolved | None, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON, without `solved`, which follows from the metrics."""
        values = self._asdict()
        del values["solved"]
        return values

    @classmethod
    def resumed(cls, values: Mapping[str, Any], run: Run, rows: Sequence[Row]) -> Self:
        """The progress that was stored; further values are ignored.

        Args:
          values: what `to_dict` gave.
          run: what is trained, which may have another threshold than when it was stored.
          rows: the metrics, of which those after the stored iteration do not count.
        """
        counts = (values["iteration"], values["seconds"], values["compile_seconds"])
        before = [row for row in rows if row["iteration"] <= values["iteration"]]
        return cls(*counts, first_solved(before, run.seed_range, run.config.stop_when_solved))

    def check(self, run: Run, iterations: np.ndarray) -> None:
        """Checks that an uninterrupted run would have come to the same states.

        Args:
          run: what is trained.
          iterations: i32[S], the iterations that the state of each seed is after.

        Raises:
          ValueError: a seed has been trained for too long, or has stopped too early.
        """
        config = run.config
        if self.iteration > config.iterations:
            raise ValueError(
                f"iterations must be at least {self.iteration}, which are done, got "
                f"{config.iterations}"
            )
        for seed, first, done in zip(run.seed_range, self.solved, iterations, strict=True):
            stops = first is not None and config.stop_when_solved > 0
            wanted = first.iteration if first is not None and stops else self.iteration
            if done != wanted:
                raise ValueError(
                    f"with stop_when_solved={config.stop_when_solved}, seed {seed} would be after "
                    f"iteration {wanted}, but it is after {done}: this run cannot be continued "
                    "with that threshold; give the former one, or begin a new run"
                )

    def active(self, config: Config) -> np.ndarray:
        """bool[S]: the seeds that have more to learn."""
        done = [config.stop_when_solved > 0 and first is not None for first in self.solved]
        return ~np.array(done) & (self.iteration < config.iterations)
