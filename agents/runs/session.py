"""A run from its start or newest checkpoint to its results.

`train_run` is all that commands need. One process does one thing at a time: an iteration, then
saving, then evaluation. No thread runs JAX in the background.
"""

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import trap_tube_jax as tt
from agents.acting.evaluation import evaluate, own_and_paper_sets
from agents.acting.policy_files import load_policy
from agents.arrays import from_arrays
from agents.command_line import option
from agents.networks.agent import num_parameters
from agents.parallel import processes
from agents.parallel.devices import Placement
from agents.ppo.learner import Learner, TrainState, make_train
from agents.ppo.memory import memory_estimate
from agents.runs import report
from agents.runs.checkpoint import CheckpointError, Checkpoints
from agents.runs.display import ProgressLine
from agents.runs.evaluator import PeriodicEvaluator, evaluation_rows, make_evaluator
from agents.runs.folder import Run, RunFolder, read_json, write_json
from agents.runs.loading import policies
from agents.runs.loggers import open_loggers
from agents.runs.metrics import CsvLog, Row, is_last
from agents.runs.provenance import provenance
from agents.runs.stopping import DivergedError, Stopped, StopSignals
from trap_tube_jax.scoring.scores import Score
from trap_tube_jax.scoring.tasks import evaluation_tasks

Advance = Callable[[TrainState, Any], tuple[TrainState, dict[str, jax.Array]]]


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """How a run is carried out; nothing here changes what it learns on one device.

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
        """Checks the numbers.

        Raises:
          ValueError: a number is too small.
        """
        smallest = {"checkpoint_every": 1, "keep": 1, "evaluate_every": 0, "reported": 1}
        for name, low in smallest.items():
            value = getattr(self, name)
            if value is not None and value < low:
                raise ValueError(f"{name} must be >= {low}, got {value}")
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
      ValueError: the run cannot be trained or continued, or it diverged (`DivergedError`).
      OSError: a file cannot be written.
      Stopped: on SIGINT or SIGTERM, after the current iteration has been saved.
    """
    options, console = options or RunOptions(), console or Console(quiet=True)
    folder = RunFolder(path)
    check_memory(run)
    with contextlib.ExitStack() as stack:

        def prepare() -> None:
            stack.enter_context(folder.lock())
            if folder.config.is_file():
                run.check_continues(RunFolder.open(path)[1])
            else:
                folder.create(run)

        processes.on_first(prepare)
        session = Session(folder, run, options, console, stop_file)
        if processes.is_first():
            folder.note(run)  # it may have other limits than before
        with session.checkpoints or contextlib.nullcontext():
            session.train()
            return session.finish()


class Session:
    """One process's part of a run: owns its state and its files."""

    def __init__(
        self,
        folder: RunFolder,
        run: Run,
        options: RunOptions,
        console: Console,
        stop_file: Path | None = None,
    ):
        """Builds the learner and restores the newest checkpoint.

        Raises:
          ValueError: the settings cannot be trained with, or the checkpoint cannot be continued.
        """
        self.folder, self.run, self.options, self.console = folder, run, options, console
        self.stop_file = stop_file
        self.placement = Placement.of(options.devices, run.config, run.seeds)
        self.learner = make_train(run.config, axis=self.placement.axis)
        self.sets = options.sets or own_and_paper_sets(run.config)
        keys = jax.vmap(jax.random.key)(np.array(run.seed_range, np.uint32))
        init = jax.jit(jax.vmap(self.learner.init))
        self._shapes = jax.eval_shape(init, keys)
        # The first process writes; all read.
        is_first = processes.is_first()
        self.checkpoints = Checkpoints(folder.checkpoints, keep=options.keep) if is_first else None
        state, record = self._restore()
        self.iteration: int = record["iteration"]
        self.seconds: float = record["seconds"]
        self.compile_seconds: float = record["compile_seconds"]
        self.state = self.placement.put(init(keys) if state is None else state)
        self.saved = self.iteration
        self.metrics = CsvLog(folder.metrics, last_iteration=self.iteration) if is_first else None
        self.evaluations = (
            CsvLog(folder.evaluations, last_iteration=self.iteration) if is_first else None
        )
        self._last = {int(row["seed"]): row for row in record["last"]}
        if self.metrics is not None and len(self.metrics.rows) < self.iteration:
            self._say(f"{folder.metrics} has lost rows; learning curves lack these iterations.")
        self._tracker = None
        if options.evaluate_every and self.evaluations is not None:
            self._tracker = PeriodicEvaluator(folder, run, self.sets)
            self._tracker.resume(self.evaluations.rows)

    @property
    def active(self) -> np.ndarray:
        """bool[S]: seeds that train on."""
        config, last = self.run.config, self._last
        over = [seed in last and is_last(last[seed], config) for seed in self.run.seed_range]
        return ~np.array(over)

    def train(self) -> None:
        """Trains until every seed has reached a limit.

        Raises:
          Stopped: on request; everything is saved.
          DivergedError: a loss or a parameter is not finite; the last checkpoint stays.
        """
        if not self.active.any():
            return
        self._note_provenance()
        count = num_parameters(self._shapes.params) // self.run.seeds
        self._say(
            f"{self.folder.path}: {tt.task_set(self.run.config.env_id).id}, curiosity "
            f"{self.run.config.curiosity}, seed {', '.join(map(str, self.run.seed_range))}, "
            f"{count:,} parameters, on {self.placement}. Compiling ..."
        )
        advance = self._compile()
        stop = StopSignals(
            lambda: self._say("Finishing this iteration; Ctrl-C again stops now."), self.stop_file
        )
        progress = ProgressLine(self.console, self.run.config.iterations)
        with stop, self._loggers() as log, progress:
            while self.active.any():
                rows = self._iterate(advance)
                log(rows)
                progress.update(rows)
                # A signal may reach any process: all have to agree on it.
                request = processes.agree(stop.request())
                due = self.iteration % self.options.checkpoint_every == 0
                if due or request or not self.active.any():
                    self._save()
                if request:
                    raise Stopped(request)

    def finish(self) -> dict[int, list[Score]]:
        """Evaluates the final policies, or the best ones; writes and returns the results."""
        state = self.placement.local(self.state)
        if self.evaluations is None:
            return {}
        final = policies(self.run, state.params, np.asarray(state.iteration))
        shown = {}
        for seed, policy in zip(self.run.seed_range, final, strict=True):
            best = self.folder.best(seed)
            shown[seed] = load_policy(best) if self._tracker and best.is_file() else policy
        tested = {
            (row["seed"], row["iteration"])
            for row in self.evaluations.rows
            if row["purpose"] == "test"
        }
        missing = [s for s, policy in shown.items() if (s, policy.iteration) not in tested]
        if not missing and (self.folder.page.exists() or not self.options.report):
            return {}
        self._say("Evaluating ...")
        tasks = self.options.reported or self.run.config.eval_episodes
        evaluator = make_evaluator(self.run, self.sets, tasks, "test")
        played = {seed: evaluator(policy.params) for seed, policy in shown.items()}
        scores = {seed: evaluator.scores(outcome) for seed, outcome in played.items()}
        for seed in missing:
            self.evaluations.append(evaluation_rows(scores[seed], shown[seed], seed, "test"))
        if self.options.report:
            first = jax.tree.map(lambda x: x[0], state)
            report.write(self.folder, self.run, self.learner, first, evaluator, played)
        return scores

    def _restore(self) -> tuple[TrainState | None, dict[str, Any]]:
        """Returns the state of the newest checkpoint, if there is one, and its record.

        Raises:
          ValueError: the checkpoint is unusable, or of other settings.
        """
        nothing = {"iteration": 0, "seconds": 0.0, "compile_seconds": 0.0, "last": []}
        if not self.folder.checkpoints.is_dir():
            return None, nothing
        with Checkpoints(self.folder.checkpoints) as checkpoints:
            if not checkpoints.iterations:
                return None, nothing
            arrays, record = checkpoints.load()
        try:
            self.run.check_continues(Run.from_dict(record["run"]))
            state = from_arrays(arrays, self._shapes)
        except (KeyError, ValueError) as error:
            raise CheckpointError(
                f"checkpoint {record['iteration']} in {self.folder.checkpoints} cannot be "
                f"continued: {error}"
            ) from error
        for row in record["last"]:
            if row["iteration"] < record["iteration"] and not is_last(row, self.run.config):
                raise ValueError(
                    f"seed {row['seed']} stopped after iteration {row['iteration']} of "
                    f"{record['iteration']}, and would train on with these limits; give the "
                    "former ones, or begin a new run"
                )
        if record["iteration"] > self.run.config.iterations:
            raise ValueError(
                f"iterations must be at least {record['iteration']}, which are done, got "
                f"{self.run.config.iterations}"
            )
        return state, record

    def _compile(self) -> Advance:
        """Compiles one iteration and the evaluation after it, for all seeds, ahead of time."""
        started = time.perf_counter()
        advance = self.placement.shard(make_advance(self.learner))
        compiled = jax.jit(advance, donate_argnums=0).lower(self.state, self.active).compile()
        self.compile_seconds += time.perf_counter() - started
        return compiled

    def _iterate(self, advance: Advance) -> list[Row]:
        """Advances the active seeds by one iteration; returns and logs their rows of metrics."""
        active, started = self.active, time.perf_counter()
        self.state, metrics = advance(self.state, active)
        metrics = self.placement.local(metrics)
        host = {name: np.asarray(values) for name, values in sorted(metrics.items())}
        taken = time.perf_counter() - started
        self.iteration, self.seconds = self.iteration + 1, self.seconds + taken
        steps, finite = host.pop("steps"), host.pop("is_finite")
        rows: list[Row] = [
            {
                "seed": seed,
                "iteration": self.iteration,
                **{name: values[index].item() for name, values in host.items()},
                "transitions_per_second": round(float(steps[index]) / taken, 1),
                "seconds": round(self.seconds, 3),
            }
            for index, seed in enumerate(self.run.seed_range)
            if active[index]
        ]
        if not finite[active].all():
            raise DivergedError(
                f"training diverged in iteration {self.iteration}: a loss or a parameter is not "
                f"finite; try a learning_rate below {self.run.config.learning_rate:g}"
            )
        if self.metrics is not None:
            self.metrics.append(rows)
        self._last |= {int(row["seed"]): row for row in rows}
        self._track(active)
        return rows

    def _track(self, active: np.ndarray) -> None:
        """Evaluates the active seeds on all sets where that is due."""
        due = self.options.evaluate_every and self.iteration % self.options.evaluate_every == 0
        if not due and (self.active == active).all():
            return
        state = self.placement.local(self.state)
        if self._tracker is None or self.evaluations is None:
            return
        found = policies(self.run, state.params, np.asarray(state.iteration))
        for index, seed in enumerate(self.run.seed_range):
            if active[index] and (due or not self.active[index]):
                self.evaluations.append(self._tracker.evaluate(seed, found[index]))

    def _save(self) -> None:
        state = self.placement.local(self.state)
        if self.checkpoints is not None:
            record = {
                "run": self.run.to_dict(),
                "seconds": self.seconds,
                "compile_seconds": self.compile_seconds,
                "last": list(self._last.values()),
            }
            self.checkpoints.save(self.iteration, state, record)
        self.saved = self.iteration

    def _note_provenance(self) -> None:
        """Adds this machine and commit to those that have trained the run."""
        if self.metrics is None:
            return
        path = self.folder.provenance
        known = read_json(path) if path.exists() else []
        here = {**provenance(), "devices": str(self.placement)}
        if here not in known:
            write_json(path, [*known, here])

    def _loggers(self) -> contextlib.AbstractContextManager[Callable[[Sequence[Row]], None]]:
        chosen = (self.options.tensorboard, self.options.wandb) if self.metrics else (False, False)
        return open_loggers(self.folder.path, self.run, tensorboard=chosen[0], wandb=chosen[1])

    def _say(self, line: str) -> None:
        self.console.print(line, soft_wrap=True, highlight=False, markup=False)


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
            after, metrics = one_seed(jax.tree.map(lambda x: x[0], states))
            return jax.tree.map(lambda x: x[None], (after, metrics))
        after, metrics = jax.vmap(one_seed)(states)
        keep = jax.vmap(jnp.where)
        return jax.tree.map(lambda new, old: keep(active, new, old), after, states), metrics

    return advance


def check_memory(run: Run) -> None:
    """Refuses a run whose arrays would not fit in this machine's memory.

    Raises:
      ValueError: they would not; the message names both sizes.
    """
    need = run.seeds * memory_estimate(run.config)
    have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if need > have:
        raise ValueError(
            f"the run needs about {need / 1e9:.1f} GB of memory, this machine has "
            f"{have / 1e9:.1f} GB: lower --seeds ({run.seeds}) or --episodes-per-iteration "
            f"({run.config.episodes_per_iteration})"
        )
