"""The history of a run, as its files hold it: checkpoint, rows and best iteration."""

import trap_tube_jax as tt
from agents.arrays import from_arrays
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


def check_rows(folder: RunFolder, iteration: int, train_set: str) -> None:
    """Raises ValueError if training from the newest checkpoint, at `iteration`, would lose results.

    Rows may go on after the checkpoint: training makes them again. Without a checkpoint it would
    replace all of them, and without the best policy it would report a worse one.

    Raises OSError if a file is missing or cannot be opened.
    """
    rows = read_rows(folder.evaluations)
    if not checkpoint.iterations(folder.checkpoints):
        if len(rows) or len(read_rows(folder.metrics)) or folder.checkpoints.is_file():
            raise ValueError(
                f"{folder.path} holds results, but no checkpoint to continue from; restore "
                f"{folder.checkpoints}, or train under another --name"
            )
    elif best_iteration(rows[rows["iteration"] < iteration], train_set) is not None:
        read_policy(folder.best)  # or damage would be noticed only at the end


def best_iteration(evaluations: Table, train_set: str) -> int | None:
    """Returns the iteration of the best validation, of equal ones the first; None without one.

    The best has the highest mean fraction of tasks solved, over the task sets. Base, a single task,
    counts only if it is the training set or the only set.
    """
    rows = evaluations.query("purpose == 'validation'")
    others = rows[rows["task_set"] != "base"]
    ranked = others if len(others) and train_set != "base" else rows
    means = (ranked["solved"] / ranked["tasks"]).groupby(ranked["iteration"]).mean()
    return int(means.idxmax()) if len(means) else None


def has_ended(folder: RunFolder, run: Run) -> bool:
    """Returns whether a run's files hold its last iteration and the test of its policy."""
    try:
        rows = read_rows(folder.metrics)
        evaluations = read_rows(folder.evaluations)
    except (ValueError, OSError):  # damaged, or being removed
        return False
    if not len(rows) or not is_last(rows.iloc[-1], run.config):
        return False
    train_set = tt.task_set(run.config.env_id).short
    best = best_iteration(evaluations, train_set)
    tested = set(evaluations.query("purpose == 'test'")["iteration"])
    return (rows["iteration"].iloc[-1] if best is None else best) in tested
