"""What a run shows, in sentences for somebody who does not know the paper."""

import shlex
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path

import trap_tube_jax as tt
from agents.runs.folder import Run, RunFolder
from agents.runs.metrics import FirstSolved
from trap_tube_jax.scoring.scores import Score

# Below LITTLE percent solved, a policy is said not to transfer, above MUCH to transfer.
LITTLE, MUCH = 20.0, 80.0


def story(
    folder: RunFolder,
    run: Run,
    results: Iterable[Sequence[Score]],
    solved: Sequence[FirstSolved | None],
    command: str,
) -> tuple[list[str], list[str]]:
    """The sentences that a run ends with: those above its tables, and those below them.

    Args:
      folder: its files.
      run: what it trained.
      results: the scores of every seed.
      solved: when each seed first solved what it trains on.
      command: the one that continues it.
    """
    own = tt.task_set(run.config.env_id)
    scores = [score for each in results for score in each]
    percent = statistics.fmean(score.percent for score in scores if score.set == own.short)
    others = [score.percent for score in scores if score.set != own.short]
    watch = f"Watch a solved episode: {folder.animation}"
    if not folder.animation.exists():
        watch = "No episode of the evaluation is solved, so there is none to watch."
    above = ["", _learnt(own, percent, solved), watch, _transfers(own, percent, others)]
    return above, ["", f"Next: {_next_step(folder, run, percent, solved, command)}"]


def _learnt(own: tt.TaskSet, percent: float, solved: Sequence[FirstSolved | None]) -> str:
    """What was learnt on the set that was trained on."""
    what = "the base task" if own.short == "base" else f"tasks of {own.label}"
    get, gets = "reach the food", "reaches the food"
    if own in tt.PAPER_TASK_SETS:  # others may have no tube
        get, gets = "get the food out of the tube with the tool", "gets the food out of the tube"
    firsts = [first for first in solved if first is not None]
    if not firsts:
        return (
            f"Learnt so far: trained on {what}, the agent {gets} in "
            f"{percent:.1f} % of its test episodes there."
        )
    episodes = round(statistics.fmean(first.episodes for first in firsts))
    seeds = "" if len(solved) == 1 else f" ({len(firsts)} of {len(solved)} seeds)"
    return (
        f"Learnt: to {get}, on {what}, after {episodes:,} episodes{seeds}. "
        f"The final agent solves {percent:.1f} % of its test episodes there."
    )


def _transfers(own: tt.TaskSet, percent: float, others: Sequence[float]) -> str:
    """Whether what was learnt carries over to the other task sets."""
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


def resume_command(folder: RunFolder, *options: str) -> str:
    """The command that continues a run, with these options."""
    out = [] if folder.path.parent == Path("runs") else ["--out", str(folder.path.parent)]
    arguments = ["--resume", "--name", folder.path.name, *out, *options]
    return f"python -m agents.train {shlex.join(arguments)}"


def _next_step(
    folder: RunFolder,
    run: Run,
    percent: float,
    solved: Sequence[FirstSolved | None],
    command: str,
) -> str:
    """What to try after a run."""
    config = run.config
    more = f"--iterations {2 * config.iterations}"
    can_go_on = not (
        config.lr_decay_fraction or config.intrinsic_coef_init or config.max_transitions
    )
    if config.stop_when_solved > 0 and all(solved):
        more += " --stop-when-solved 0"
        can_go_on &= run.seeds == 1  # several may have stopped at different iterations
    if percent < MUCH and can_go_on:
        return f"train longer with {command} {more}"
    own = tt.task_set(config.env_id)
    if own in tt.PAPER_TASK_SETS and own.short != "pstsy":
        return "train on all transfers at once with python -m agents.train --preset best"
    path = shlex.quote(str(folder.path))
    return f"compare with shortest plans, python -m agents.evaluate {path} --optimality"
