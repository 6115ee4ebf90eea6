"""How far a run has come."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from agents.runs.folder import Run
from agents.runs.metrics import FirstSolved, Row, first_solved, is_last


class Progress(NamedTuple):
    """What a run has come to, beside the state of training.

    Attributes:
      iteration: iterations done by the seeds that still train.
      seconds: seconds of training, compilation excluded.
      compile_seconds: seconds of compiling the iteration, over all processes.
      solved: for each seed, when it was first solved.
      ended: for each seed, the iteration after which it trains no more.
    """

    iteration: int
    seconds: float
    compile_seconds: float
    solved: tuple[FirstSolved | None, ...]
    ended: tuple[int | None, ...]

    @classmethod
    def start(cls, run: Run) -> Self:
        """That of a run which begins."""
        return cls(0, 0.0, 0.0, (None,) * run.seeds, (None,) * run.seeds)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON, without what follows from the metrics."""
        values = self._asdict()
        del values["solved"], values["ended"]
        return values

    @classmethod
    def resumed(cls, values: Mapping[str, Any], run: Run, rows: Iterable[Row]) -> Self:
        """The progress that was stored; further values are ignored.

        Args:
          values: what `to_dict` gave.
          run: what is trained, which may have other limits than when it was stored.
          rows: the metrics, of which those after the stored iteration do not count.
        """
        counts = (values["iteration"], values["seconds"], values["compile_seconds"])
        before = [row for row in rows if row["iteration"] <= values["iteration"]]
        nothing = (None,) * run.seeds
        return cls(*counts, nothing, nothing).after(run, before)

    def after(self, run: Run, rows: Sequence[Row]) -> Self:
        """With what further rows of metrics say of `solved` and `ended`."""
        solved = first_solved(rows, run.seed_range, run.config.stop_when_solved)
        ended: dict[int, int] = {}
        for row in rows:
            if is_last(row, run.config):
                ended.setdefault(int(row["seed"]), int(row["iteration"]))
        return self._replace(
            solved=tuple(old or new for old, new in zip(self.solved, solved, strict=True)),
            ended=tuple(
                old or ended.get(seed) for old, seed in zip(self.ended, run.seed_range, strict=True)
            ),
        )

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
        for seed, ended, done in zip(run.seed_range, self.ended, iterations, strict=True):
            wanted = ended or self.iteration
            if done != wanted:
                raise ValueError(
                    f"with stop_when_solved={config.stop_when_solved} and "
                    f"max_transitions={config.max_transitions}, seed {seed} would be after "
                    f"iteration {wanted}, but it is after {done}: this run cannot be continued "
                    "with these limits; give the former ones, or begin a new run"
                )

    @property
    def active(self) -> np.ndarray:
        """bool[S]: the seeds that have more to learn."""
        return np.array([ended is None for ended in self.ended])
