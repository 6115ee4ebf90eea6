"""The history of a run, as its files hold it: checkpoint, rows and best policy."""

from agents.arrays import from_arrays, read_arrays
from agents.files import naming_file
from agents.ppo.learner import TrainState
from agents.runs import checkpoint
from agents.runs.folder import RunFolder
from agents.runs.loading import read_policy
from agents.runs.metrics import COLUMNS, Row, Table, is_last, read_rows
from agents.runs.run import Run


def restore(folder: RunFolder, shapes: TrainState) -> tuple[TrainState | None, Row | None]:
    """Returns the newest checkpoint's state and row of metrics; None for one that is missing.

    Raises ValueError for a checkpoint of other settings, or of a version with other metrics.
    """
    if not checkpoint.iterations(folder.checkpoints):
        return None, None
    arrays, row = checkpoint.load(folder.checkpoints)
    done = row["iteration"]
    try:
        state = from_arrays(arrays, shapes)
        if done and (missing := COLUMNS["metrics.csv"].keys() - row):
            raise ValueError(f"it has no {', '.join(sorted(missing))}")
    except ValueError as error:
        raise ValueError(
            f"checkpoint {done} in {folder.checkpoints} cannot be continued: {error}"
        ) from error
    return state, row if done else None


def check_rows(folder: RunFolder, iteration: int) -> None:
    """Raises ValueError unless a run's rows lead up to its newest checkpoint, at `iteration`.

    Rows may go on after the checkpoint: training makes them again. Without a checkpoint it would
    replace all of them, which may be the only results.
    """
    rows = read_rows(folder.metrics)
    evaluated = read_rows(folder.evaluations)
    if not checkpoint.iterations(folder.checkpoints):
        if len(rows) or len(evaluated) or folder.checkpoints.is_file():
            raise ValueError(
                f"{folder.path} holds results, but no checkpoint to continue from; restore "
                f"{folder.checkpoints}, or train under another --name"
            )
    elif max(rows["iteration"], default=0) < iteration:
        raise ValueError(
            f"{folder.metrics} ends before the checkpoint of iteration {iteration} (a line "
            "without its newline does not count); restore it, or train under another --name"
        )


def has_ended(folder: RunFolder, run: Run) -> bool:
    """Returns whether a run's files hold its last iteration and the test of its policy."""
    try:
        rows = read_rows(folder.metrics)
        tested = set(read_rows(folder.evaluations).query("purpose == 'test'")["iteration"])
        if not len(rows) or not is_last(rows.iloc[-1], run.config):
            return False
        return bool(tested & {rows["iteration"].iloc[-1], best_iteration(folder)})
    except (ValueError, OSError):  # damaged, or being removed
        return False


def check_best(folder: RunFolder, iteration: int) -> None:
    """Raises ValueError unless a run's best policy can be compared with later ones."""
    rows = validation_rows(folder)
    best = best_iteration(folder)
    if best is None:
        if min(rows["iteration"], default=iteration) < iteration:
            raise ValueError(
                f"{folder.best} is missing, although {folder.evaluations} has evaluations; restore "
                "it, or train under another --name"
            )
        return
    read_policy(folder.best)  # or damage would be noticed only at the end
    if best <= iteration and best not in set(rows["iteration"]):
        raise ValueError(
            f"{folder.evaluations} lacks the evaluation of iteration {best}, whose policy is in "
            f"{folder.best}; restore it, or train under another --name"
        )


def validation_rows(folder: RunFolder) -> Table:
    """Returns the evaluations that select the best policy."""
    return read_rows(folder.evaluations).query("purpose == 'validation'")


def best_iteration(folder: RunFolder) -> int | None:
    """Returns the iteration of the best policy so far; None if there is none."""
    if not folder.best.is_file():
        return None
    _, about = read_arrays(folder.best)
    with naming_file(folder.best):
        return about["iteration"]


def is_better(rows: Table, iteration: int, best: int | None, train_set: str) -> bool:
    """Returns whether an evaluation is better than the best iteration's so far.

    Compares the mean fractions of validation tasks solved, over the task sets. Base, a single task,
    counts only if it is the training set or the only set.
    """
    others = rows[rows["task_set"] != "base"]
    ranked = others if len(others) and train_set != "base" else rows
    means = (ranked["solved"] / ranked["tasks"]).groupby(ranked["iteration"]).mean()
    if iteration not in means or best not in means:
        return iteration in means
    return bool(means[iteration] > means[best])
