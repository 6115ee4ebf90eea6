"""A run from its start or newest checkpoint to its results.

`train_run` is all that commands need. One process does one thing at a time: an iteration, then
saving, then evaluation. No thread runs JAX in the background.
"""

import dataclasses
import importlib
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluator, evaluate, own_and_paper_sets
from agents.acting.policy import Policy
from agents.arrays import from_arrays
from agents.networks.agent import PARTS
from agents.parallel import processes
from agents.parallel.devices import Placement
from agents.ppo.learner import Learner, TrainState, make_learner
from agents.runs import checkpoint, report
from agents.runs.display import ProgressLine
from agents.runs.folder import RunFolder
from agents.runs.loading import read_policy, save
from agents.runs.loggers import open_loggers
from agents.runs.metrics import Row, append_rows, evaluation_rows, is_last, read_rows, rewind_rows
from agents.runs.provenance import note_provenance
from agents.runs.run import Run, RunOptions
from agents.runs.stopping import Stopped, stop_signals
from trap_tube_jax.imports import needs_extra
from trap_tube_jax.scoring.scores import Scores
from trap_tube_jax.scoring.tasks import evaluation_tasks

Advance = Callable[[TrainState], tuple[TrainState, dict[str, jax.Array]]]


def train_run(
    path: str | Path,
    run: Run,
    options: RunOptions | None = None,
    *,
    console: Console | None = None,
    stop_file: Path | None = None,
) -> Scores | None:
    """Trains a run to its end from its newest checkpoint, evaluates it and writes its files.

    A finished run is left unchanged. Only one process at a time may call `train_run` for a folder.

    Args:
      path: the run's folder, made if missing; `~` is the home folder.
      run: what to train; of a stored run only `EXTENDABLE` settings may differ.
      options: how to train.
      console: where progress is shown; nowhere if None.
      stop_file: training stops as on SIGTERM once this file exists. Unlike a signal, a file reaches
        threads and other hosts.

    Returns:
      The scores on test tasks; None if the run was finished before.

    Raises:
      ValueError: the run cannot be trained or continued, or it diverged.
      OSError: a file cannot be written.
      Stopped: on SIGINT or SIGTERM, after the current iteration has been saved.
    """
    options, console = options or RunOptions(), console or Console(quiet=True)
    stored = RunFolder(Path(path).expanduser())
    if stored.config.is_file():
        run.check_continues(stored.read()[0])
    is_first = jax.process_index() == 0
    if not is_first:  # only the first process's files are kept
        options = dataclasses.replace(options, report=False, tensorboard=False, wandb=False)
    with needs_extra("logging"):  # before anything is compiled or written
        for name in ("tensorboard", "wandb"):
            if getattr(options, name):
                importlib.import_module(name)
    with stored.lock() if is_first else tempfile.TemporaryDirectory() as copy:
        folder = stored if copy is None else RunFolder(Path(copy))
        session = Session(run, options, console, stored, folder, stop_file)
        session.train()
        return session.finish()


class Session:
    """One process's part of a run: owns its state and its files."""

    def __init__(
        self,
        run: Run,
        options: RunOptions,
        console: Console,
        stored: RunFolder,
        folder: RunFolder,
        stop_file: Path | None,
    ):
        """Builds the learner and restores the newest checkpoint of `stored`; writes to `folder`."""
        self.run, self.options, self.console = run, options, console
        self.stored, self.folder, self.stop_file = stored, folder, stop_file
        self.placement = Placement.of(options.devices, run.config)
        self.learner = make_learner(run.config, axis=self.placement.axis)
        self.sets = options.sets or own_and_paper_sets(run.config)
        key = jax.random.key(run.seed)
        shapes = jax.eval_shape(self.learner.init, key)
        state, self.last = restore(stored.checkpoints, run.config.iterations, shapes)
        check_agreement(stored, self.iteration)
        self.state = self.placement.put(self.learner.init(key) if state is None else state)
        folder.note(run, options)  # they may differ from those before
        if self.last is None:
            self._save()  # from now on, rows without a checkpoint mean that files were removed
        for rows in (folder.metrics, folder.evaluations):
            rewind_rows(rows, self.iteration)
        self._validate = None
        if options.evaluate_every:
            tasks = run.config.eval_episodes
            self._validate = Evaluator.of_sets(run.config, self.sets, tasks, "validation")
            self._keep_best()  # a kill may have come between checkpoint and best policy

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self.last["iteration"] if self.last else 0

    @property
    def done(self) -> bool:
        """True if the run has reached a limit."""
        return self.last is not None and is_last(self.last, self.run.config)

    def train(self) -> None:
        """Trains until the run has reached a limit."""
        if self.done:
            return
        self.folder.page.unlink(missing_ok=True)  # it would show the run as it was
        note_provenance(self.folder.provenance, str(self.placement))
        config = self.run.config
        count = sum(leaf.size for leaf in jax.tree.leaves(self.state.params))
        self.console.out(
            f"{self.folder.path}: {tt.task_set(config.env_id).id}, curiosity {config.curiosity}, "
            f"seed {self.run.seed}, {count:,} parameters, on "
            f"{self.placement}. Compiling ...",
        )
        advance = self.placement.shard(make_advance(self.learner))
        advance = jax.jit(advance, donate_argnums=0).lower(self.state).compile()
        chosen = {"tensorboard": self.options.tensorboard, "wandb": self.options.wandb}
        with (
            stop_signals(self.console.out, self.stop_file) as request,
            open_loggers(self.folder.path, self.run, **chosen) as log,
            ProgressLine(self.console, config.iterations) as progress,
        ):
            while not self.done:
                row = self._iterate(advance)
                log(row)
                progress.show(row)
                # A signal may reach any process: all have to agree on it.
                number = processes.max_over_processes(request())
                due = self.iteration % self.options.checkpoint_every == 0
                if due or number or self.done:
                    self._save()
                if number:
                    raise Stopped(number)

    def finish(self) -> Scores | None:
        """Evaluates the final policy, or the best one; writes and returns the results."""
        policy = self._policy()
        if self.options.evaluate_every and self.stored.best.is_file():
            policy = read_policy(self.stored.best)
        tested = read_rows(self.stored.evaluations).query("purpose == 'test'")
        is_tested = policy.iteration in set(tested["iteration"])
        if is_tested and (self.folder.page.exists() or not self.options.report):
            self.console.out("Tested before; python -m agents.evaluate plays other sets and tasks.")
            return None
        self.console.out("Evaluating ...")
        tasks = self.options.test_tasks or self.run.config.eval_episodes
        evaluator = Evaluator.of_sets(self.run.config, self.sets, tasks)
        played = evaluator(policy.params)
        scores = evaluator.scores(played)
        if not is_tested:
            append_rows(self.folder.evaluations, evaluation_rows(scores, policy, "test"))
        if self.options.report:
            report.write(self.folder, self.run, evaluator, played)
        return scores

    def _iterate(self, advance: Advance) -> Row:
        """Trains for one iteration; returns and writes its row of metrics."""
        started = time.perf_counter()
        self.state, metrics = advance(self.state)
        host = jax.tree.map(np.asarray, self.placement.local(metrics))
        taken = time.perf_counter() - started
        steps, iteration = host.pop("steps"), self.iteration + 1
        # A parameter is infinite or NaN only if the norm of a gradient is.
        if not all(np.isfinite(metric).all() for metric in host.values()):
            raise ValueError(
                f"training diverged in iteration {iteration}: a loss or a gradient is not "
                f"finite; try a learning_rate below {self.run.config.learning_rate:g}"
            )
        host["validation_success"] = host[
            "validation_success"
        ].mean()  # in float64, to compare with thresholds
        self.last = {
            "iteration": iteration,
            **{name: host[name].item() for name in sorted(host)},
            "transitions_per_second": round(float(steps) / taken, 1),
            "seconds": round((self.last or {"seconds": 0.0})["seconds"] + taken, 3),
        }
        append_rows(self.folder.metrics, [self.last])
        if self._validate and (iteration % self.options.evaluate_every == 0 or self.done):
            policy = self._policy()
            scores = self._validate.scores(self._validate(policy.params))
            append_rows(self.folder.evaluations, evaluation_rows(scores, policy, "validation"))
            self._keep_best()
        return self.last

    def _keep_best(self) -> None:
        """Saves the present policy if its evaluation is the best so far."""
        rows, own = read_rows(self.folder.evaluations), tt.task_set(self.run.config.env_id).short
        if best_iteration(rows, own) == self.iteration:
            self._save()  # first, or a resume could start before the best policy
            save(self.folder.best, self._policy())

    def _policy(self) -> Policy:
        params = self.placement.local({part: self.state.params[part] for part in PARTS})
        return Policy(f"seed {self.run.seed}", self.run.config, params, self.iteration)

    def _save(self) -> None:
        state = self.placement.local(self.state)
        checkpoint.save(self.folder.checkpoints, self.iteration, state, dict(self.last or {}))


def restore(
    folder: Path, iterations: int, shapes: TrainState
) -> tuple[TrainState | None, Row | None]:
    """Returns the newest checkpoint's state and row of metrics; None for what there is not yet.

    Raises ValueError for a checkpoint of other settings.
    """
    if not checkpoint.iterations(folder):
        return None, None
    arrays, row = checkpoint.load(folder)
    done = row["iteration"]
    try:
        state = from_arrays(arrays, shapes)
    except ValueError as error:
        raise ValueError(f"checkpoint {done} in {folder} cannot be continued: {error}") from error
    if done > iterations:
        raise ValueError(f"iterations must be at least {done}, which are done, got {iterations}")
    return state, row if done else None


def check_agreement(folder: RunFolder, iteration: int) -> None:
    """Raises ValueError unless a run's rows lead up to its newest checkpoint, at `iteration`.

    Rows may go on after the checkpoint: training makes them again. Without a checkpoint it would
    make all of them again, in the place of results that may be the only ones.
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
            f"{folder.metrics} ends before the checkpoint of iteration {iteration}; restore it, or "
            "train under another --name"
        )


def best_iteration(rows: Any, own: str) -> int | None:
    """Returns the first iteration with the highest mean fraction of validation tasks solved.

    None if no evaluation is among the rows. The mean is over task sets; base, a single task, counts
    only if it is the training set `own`.
    """
    rows = rows[rows["purpose"] == "validation"]
    ranked = rows if own == "base" else rows[rows["task_set"] != "base"]
    ranked = ranked if len(ranked) else rows
    solved = ranked["solved"] / ranked["tasks"]
    means = solved.groupby(ranked["iteration"]).mean()
    return int(means.idxmax()) if len(means) else None


def make_advance(learner: Learner) -> Advance:
    """Returns a function that trains for one iteration and plays the validation tasks greedily.

    The metrics include `validation_success`, bool[B], whether each task is solved.
    """
    config = learner.config
    tasks = evaluation_tasks(config.env_id, config.eval_episodes, config.num_features, "validation")

    def advance(state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        after, metrics = learner.iterate(state)
        outcome = evaluate(learner.agent, after.params, learner.env, tasks)
        return after, {
            **metrics,
            "validation_success": outcome.solved,
            "episodes": after.iteration * config.episodes_per_iteration,
            "transitions": after.transitions,
            "steps": after.transitions - state.transitions,
        }

    return advance
