"""What a run shows, in sentences for somebody who does not know the paper."""

import statistics
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import trap_tube_jax as tt
from agents.acting.scores import Score
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import FirstSolved

LITTLE, MUCH = 20.0, 80.0  # percent solved, below and above which transfer is named no and yes


class Story(NamedTuple):
    """The sentences that a run ends with.

    Attributes:
      before: above the tables.
      after: below them.
    """

    before: list[str]
    after: list[str]

    @classmethod
    def of(
        cls,
        folder: RunFolder,
        run: Run,
        results: Iterable[Sequence[Score]],
        solved: Sequence[FirstSolved | None],
    ) -> "Story":
        """The story of a run.

        Args:
          folder: its files.
          run: what it trained.
          results: the scores of every seed.
          solved: when each seed first solved what it trains on.
        """
        own = tt.task_set(run.config.env_id)
        scores = [score for each in results for score in each]
        percent = statistics.fmean(score.percent for score in scores if score.set == own.short)
        others = [score.percent for score in scores if score.set != own.short]
        watch = f"Watch a solved episode: {folder.animation}"
        if not folder.animation.exists():
            watch = "No episode of the evaluation is solved, so there is none to watch."
        return cls(
            before=["", learnt(own, percent, solved), watch, transfers(own, percent, others)],
            after=["", f"Next: {next_command(folder, run, percent)}"],
        )


def learnt(own: tt.TaskSet, percent: float, solved: Sequence[FirstSolved | None]) -> str:
    """What was learnt on the set that was trained on."""
    what = "the base task" if own.short == "base" else f"tasks of {own.label}"
    firsts = [first for first in solved if first is not None]
    if not firsts:
        return (
            f"Learnt so far: trained on {what}, the agent gets the food out of the tube in "
            f"{percent:.1f} % of its test episodes there."
        )
    episodes = round(statistics.fmean(first.episodes for first in firsts))
    seeds = "" if len(solved) == 1 else f" ({len(firsts)} of {len(solved)} seeds)"
    return (
        f"Learnt: to get the food out of the tube with the tool, on {what}, after {episodes:,} "
        f"episodes{seeds}. The final agent solves {percent:.1f} % of its test episodes there."
    )


def transfers(own: tt.TaskSet, percent: float, others: Sequence[float]) -> str:
    """Whether what was learnt carries over to the other task sets.

    Args:
      own: the set that was trained on.
      percent: of its tasks, percent solved.
      others: percent solved of each other set.
    """
    if percent == 0:
        return "Nothing is learnt yet that could carry over to the other task sets."
    mean = statistics.fmean(others)
    verdict = "does not transfer" if mean < LITTLE else "transfers in part"
    if mean > MUCH:
        verdict = "transfers"
    return (
        f"It {verdict}: on the sets other than {own.label}, which change layout {{P}}, colours "
        f"{{St}} or the tool's looks {{Sy}}, it solves {mean:.1f} % of the tasks on average."
    )


def next_command(folder: RunFolder, run: Run, percent: float) -> str:
    """The command to try after a run that solves so many percent of its own tasks."""
    config = run.config
    if percent < MUCH and not (config.cooldown or config.intrinsic_start):
        out = "" if str(folder.path.parent) == "runs" else f" --out {folder.path.parent}"
        return (
            f"train longer with python -m agents.train --resume --name {folder.path.name}{out} "
            f"--iterations {2 * config.iterations}"
        )
    if tt.task_set(config.env_id).short != "pstsy":
        return "train on all transfers at once with python -m agents.train --preset best"
    return f"compare with shortest plans, python -m agents.evaluate {folder.path} --optimality"
