"""A run from its start or newest checkpoint to its results.

`train_run` is all that commands need. One process does one thing at a time: an iteration, then
saving, then evaluation. No thread runs JAX in the background.
"""

import dataclasses
import functools
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluator, evaluate, own_and_paper_sets
from agents.acting.policy import Policy
from agents.acting.policy_files import load_policy, save_policy
from agents.arrays import from_arrays, is_key, key_data
from agents.command_line import option
from agents.networks.agent import num_parameters
from agents.parallel import processes
from agents.parallel.devices import Placement
from agents.ppo.learner import Learner, TrainState, make_train
from agents.runs import checkpoint, report
from agents.runs.display import ProgressLine, say
from agents.runs.folder import Run, RunFolder
from agents.runs.loading import policies
from agents.runs.loggers import open_loggers
from agents.runs.metrics import (
    Frame,
    Row,
    append_rows,
    evaluation_rows,
    is_last,
    read_rows,
    rewind_rows,
)
from agents.runs.provenance import note_provenance
from agents.runs.stopping import Stopped, stop_signals
from trap_tube_jax.checks import MOST_TASKS, check_integer
from trap_tube_jax.objects import BOARD_SIZE
from trap_tube_jax.scoring.scores import Score
from trap_tube_jax.scoring.tasks import evaluation_tasks
from trap_tube_jax.state import take

Advance = Callable[[TrainState, Any], tuple[TrainState, dict[str, jax.Array]]]


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Options of carrying out a run; none changes what it learns on one device.

    Attributes:
      checkpoint_every: iterations between checkpoints.
      keep: number of newest checkpoints to keep.
      evaluate_every: iterations between evaluations on `sets`; 0 for none. The best evaluation
        selects the parameters that the run reports.
      sets: short names of the sets to evaluate on; the paper's eight and the training set if
        absent.
      reported: test tasks per set in the final evaluation; `eval_episodes` if absent.
      report: writes curves, page and GIF at the end.
      tensorboard: logs metrics for TensorBoard.
      wandb: logs metrics to Weights & Biases; offline with WANDB_MODE=offline.
      devices: devices that share the run; one if absent, all if distributed. See `Placement.of`.
    """

    checkpoint_every: int = option(10, "run")
    keep: int = option(3, "run")
    evaluate_every: int = option(0, "run")
    sets: tuple[str, ...] | None = option(None, "run")
    reported: int | None = option(None, "run")
    report: bool = option(True, "run")
    tensorboard: bool = option(False, "run")
    wandb: bool = option(False, "run")
    devices: int | None = option(None, "devices and hosts")

    def __post_init__(self) -> None:
        """Raises ValueError for a number that is too small or an unknown set."""
        check_integer("checkpoint_every", self.checkpoint_every)
        check_integer("keep", self.keep)
        check_integer("evaluate_every", self.evaluate_every, minimum=0)
        if self.reported is not None:
            check_integer("reported", self.reported, maximum=MOST_TASKS)
        for name in self.sets or ():
            tt.task_set(name)


def train_run(
    path: Path,
    run: Run,
    options: RunOptions | None = None,
    *,
    console: Console | None = None,
    stop_file: Path | None = None,
) -> dict[int, list[Score]]:
    """Trains a run to its end from its newest checkpoint, evaluates it and writes its files.

    A finished run is left as it is. Only one process may call it for a folder at a time.

    Args:
      path: the run's folder, made if missing.
      run: what to train; of a stored run only `EXTENDABLE` settings may differ.
      options: how to train.
      console: where progress is shown; nowhere if None.
      stop_file: training stops as by SIGTERM once this file exists, which reaches threads and
        other hosts.

    Returns:
      The scores on test tasks by seed; none if the run was finished before.

    Raises:
      ValueError: the run cannot be trained or continued, or it diverged.
      OSError: a file cannot be written.
      Stopped: on SIGINT or SIGTERM, after the current iteration has been saved.
    """
    options, console = options or RunOptions(), console or Console(quiet=True)
    folder = RunFolder(path)
    if jax.process_index() > 0:  # of several processes the first one's files are kept
        with tempfile.TemporaryDirectory() as copy:
            Session(run, options, console, folder, RunFolder(Path(copy)), stop_file).train()
        return {}
    with folder.opened_for(run):
        session = Session(run, options, console, folder, folder, stop_file)
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
        self.folder, self.stop_file = folder, stop_file
        self.placement = Placement.of(options.devices, run.config, run.seeds)
        self.learner = make_train(run.config, axis=self.placement.axis)
        self.sets = options.sets or own_and_paper_sets(run.config)
        keys = jax.vmap(jax.random.key)(np.array(run.seed_range, np.uint32))
        init = jax.jit(jax.vmap(self.learner.init))
        shapes = jax.eval_shape(init, keys)
        check_memory(run, self.learner, shapes)
        state, self.iteration, self._last = restore(stored.checkpoints, run, shapes)
        self.seconds = max((row["seconds"] for row in self._last.values()), default=0.0)
        self.state = self.placement.put(init(keys) if state is None else state)
        for path in (folder.metrics, folder.evaluations):
            rewind_rows(path, self.iteration)
        if read_rows(folder.metrics)["iteration"].nunique() < self.iteration:
            say(console, f"{folder.metrics} has lost rows; learning curves lack these iterations.")
        self._validate = None
        if options.evaluate_every:
            tasks = run.config.eval_episodes
            self._validate = Evaluator.of_sets(run.config, self.sets, tasks, "validation")
        folder.note(run)  # it may have other limits than before

    @property
    def active(self) -> np.ndarray:
        """bool[S]: seeds that train on."""
        config, last = self.run.config, self._last
        over = [seed in last and is_last(last[seed], config) for seed in self.run.seed_range]
        return ~np.array(over)

    def train(self) -> None:
        """Trains until every seed has reached a limit."""
        if not self.active.any():
            return
        note_provenance(self.folder.provenance, str(self.placement))
        count = num_parameters(self.state.params) // self.run.seeds
        say(
            self.console,
            f"{self.folder.path}: {tt.task_set(self.run.config.env_id).id}, curiosity "
            f"{self.run.config.curiosity}, seed {', '.join(map(str, self.run.seed_range))}, "
            f"{count:,} parameters, on {self.placement}. Compiling ...",
        )
        advance = self.placement.shard(make_advance(self.learner))
        advance = jax.jit(advance, donate_argnums=0).lower(self.state, self.active).compile()
        chosen = {"tensorboard": self.options.tensorboard, "wandb": self.options.wandb}
        asked = functools.partial(
            say, self.console, "Finishing this iteration; Ctrl-C again stops now."
        )
        with (
            stop_signals(asked, self.stop_file) as request,
            open_loggers(self.folder.path, self.run, **chosen) as log,
            ProgressLine(self.console, self.run.config.iterations) as progress,
        ):
            while self.active.any():
                rows = self._iterate(advance)
                log(rows)
                progress.show(rows)
                # A signal may reach any process: all have to agree on it.
                number = processes.agree(request())
                due = self.iteration % self.options.checkpoint_every == 0
                if due or number or not self.active.any():
                    self._save()
                if number:
                    raise Stopped(number)

    def finish(self) -> dict[int, list[Score]]:
        """Evaluates the final policies, or the best ones; writes and returns the results."""
        shown = self._policies()
        for seed in shown:
            if self._validate and self.folder.best(seed).is_file():
                shown[seed] = load_policy(self.folder.best(seed))
        rows = read_rows(self.folder.evaluations).query("purpose == 'test'")
        known = set(zip(rows["seed"], rows["iteration"], strict=True))
        missing = [seed for seed in shown if (seed, shown[seed].iteration) not in known]
        if not missing and (self.folder.page.exists() or not self.options.report):
            return {}
        say(self.console, "Evaluating ...")
        tasks = self.options.reported or self.run.config.eval_episodes
        evaluator = Evaluator.of_sets(self.run.config, self.sets, tasks)
        played = {seed: evaluator(policy.params) for seed, policy in shown.items()}
        scores = {seed: evaluator.scores(outcome) for seed, outcome in played.items()}
        for seed in missing:
            rows = evaluation_rows(scores[seed], shown[seed], seed, "test")
            append_rows(self.folder.evaluations, rows)
        if self.options.report:
            report.write(self.folder, self.run, evaluator, played)
        return scores

    def _iterate(self, advance: Advance) -> list[Row]:
        """Advances the active seeds by one iteration; returns and writes their rows of metrics."""
        active, started = self.active, time.perf_counter()
        self.state, metrics = advance(self.state, active)
        host = jax.tree.map(np.asarray, self.placement.local(metrics))
        taken = time.perf_counter() - started
        self.iteration, self.seconds = self.iteration + 1, self.seconds + taken
        steps, finite = host.pop("steps"), host.pop("is_finite")
        if not finite[active].all():
            raise ValueError(
                f"training diverged in iteration {self.iteration}: a loss or a parameter is not "
                f"finite; try a learning_rate below {self.run.config.learning_rate:g}"
            )
        rows: dict[int, Row] = {
            seed: {
                "seed": seed,
                "iteration": self.iteration,
                **{name: host[name][index].item() for name in sorted(host)},
                "transitions_per_second": round(float(steps[index]) / taken, 1),
                "seconds": round(self.seconds, 3),
            }
            for index, seed in enumerate(self.run.seed_range)
            if active[index]
        }
        append_rows(self.folder.metrics, list(rows.values()))
        self._last |= rows
        if self._validate:
            due = self.iteration % self.options.evaluate_every == 0
            self._evaluate(self._validate, active if due else active & ~self.active)
        return list(rows.values())

    def _evaluate(self, evaluator: Evaluator, chosen: np.ndarray) -> None:
        """Evaluates the chosen seeds, bool[S]; saves a policy that is the best of its seed."""
        found = self._policies() if chosen.any() else {}
        own = tt.task_set(self.run.config.env_id).short
        for seed in np.array(self.run.seed_range)[chosen].tolist():
            policy, path = found[seed], self.folder.evaluations
            scores = evaluator.scores(evaluator(policy.params))
            append_rows(path, evaluation_rows(scores, policy, seed, "validation"))
            if best_iteration(read_rows(path), seed, own) == self.iteration:
                save_policy(self.folder.best(seed), policy)

    def _policies(self) -> dict[int, Policy]:
        """Returns the present policy of each seed."""
        state = self.placement.local(self.state)
        return policies(self.run, state.params, np.asarray(state.iteration))

    def _save(self) -> None:
        record = {"run": self.run.to_dict(), "last": list(self._last.values())}
        state, keep = self.placement.local(self.state), self.options.keep
        checkpoint.save(self.folder.checkpoints, self.iteration, state, record, keep=keep)


def restore(
    folder: Path, run: Run, shapes: TrainState
) -> tuple[TrainState | None, int, dict[int, Row]]:
    """Returns the newest checkpoint's state and iteration, and the last row of each seed.

    Without a checkpoint these are None, 0 and no row; one of other settings raises ValueError.
    """
    if not checkpoint.iterations(folder):
        return None, 0, {}
    arrays, record = checkpoint.load(folder)
    done = record["iteration"]
    try:
        run.check_continues(Run.from_dict(record["run"]))
        state = from_arrays(arrays, shapes)
    except (KeyError, ValueError) as error:
        raise ValueError(f"checkpoint {done} in {folder} cannot be continued: {error}") from error
    for row in record["last"]:
        if row["iteration"] < done and not is_last(row, run.config):
            raise ValueError(
                f"seed {row['seed']} stopped after iteration {row['iteration']} of {done}, and "
                "would train on with these limits; give the former ones, or begin a new run"
            )
    if done > run.config.iterations:
        raise ValueError(
            f"iterations must be at least {done}, which are done, got {run.config.iterations}"
        )
    return state, done, {row["seed"]: row for row in record["last"]}


def best_iteration(rows: Frame, seed: int, own: str) -> int:
    """Returns when a seed first solved its highest mean fraction of the validation tasks.

    The mean is over task sets; base, a single task, counts only if it is the training set `own`.
    """
    rows = rows[(rows["purpose"] == "validation") & (rows["seed"] == seed)]
    ranked = rows if own == "base" else rows[rows["task_set"] != "base"]
    ranked = ranked if len(ranked) else rows
    solved = ranked["solved"] / ranked["tasks"]
    return int(solved.groupby(ranked["iteration"]).mean().idxmax())


def make_advance(learner: Learner) -> Advance:
    """Returns a function that trains all active seeds for one iteration and evaluates them.

    It maps states [S, ...] and bool[S] to the next states and metrics [S]; seeds that are not
    active stay as they are.
    """
    config = learner.config
    tasks = evaluation_tasks(config.env_id, config.eval_episodes, config.num_features, "validation")

    def one_seed(state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        after, metrics = learner.iterate(state)
        outcome = evaluate(learner.agent, after.params, learner.env, tasks)
        return after, {
            **metrics,
            "evaluation": jnp.mean(outcome.solved.astype(jnp.float32)),
            "episodes": after.episodes,
            "transitions": after.transitions,
            "steps": after.transitions - state.transitions,
        }

    def advance(states: TrainState, active: Any) -> tuple[TrainState, dict[str, jax.Array]]:
        if len(active) == 1:  # a run whose only seed is not active is over
            after, metrics = one_seed(take(states, 0))
            return jax.tree.map(lambda x: x[None], (after, metrics))
        after, metrics = jax.vmap(one_seed)(states)
        return jax.tree.map(functools.partial(_where, active), after, states), metrics

    return advance


def _where(chosen: Any, new: jax.Array, old: jax.Array) -> jax.Array:
    """Takes `new` [S, ...] where `chosen` bool[S], else `old`; keys as data, used or not."""
    data = jax.vmap(jnp.where)(chosen, key_data(new), key_data(old))
    return jax.random.wrap_key_data(data, impl=jax.random.key_impl(new)) if is_key(new) else data


def check_memory(run: Run, learner: Learner, states: TrainState) -> None:
    """Raises ValueError if a run's states [S, ...] and boards alone would not fit in memory."""
    episodes = run.config.episodes_per_iteration
    boards = run.seeds * episodes * learner.env.max_steps * BOARD_SIZE**2 * run.config.num_features
    need = boards + sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(states))
    have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if need > have:
        raise ValueError(
            f"the run needs at least {need / 1e9:.1f} GB of memory, this machine has "
            f"{have / 1e9:.1f} GB: lower --seeds ({run.seeds}) or --episodes-per-iteration "
            f"({episodes})"
        )
