"""A run from its start or newest checkpoint to its results: training, saving, reporting."""

import dataclasses
import functools
import time
from collections.abc import Sequence
from concurrent import futures
from typing import Any

import jax
import numpy as np
from rich.console import Console

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluator, own_and_paper_sets
from agents.acting.policy import Policy
from agents.arrays import from_arrays, to_arrays
from agents.networks.agent import PARTS, num_parameters
from agents.parallel import processes
from agents.parallel.sharding import Placement
from agents.ppo.learner import TrainState, make_train
from agents.runs import report, report_page
from agents.runs.checkpoint import Checkpoints
from agents.runs.compilation import compiled, in_background
from agents.runs.folder import Run, RunFolder, write_json
from agents.runs.loading import policies
from agents.runs.metrics import MetricsLog, Row, read_metrics
from agents.runs.programs import Programs
from agents.runs.progress import Progress
from agents.runs.stopping import Stopped, StopSignals
from agents.runs.story import resume_command, story
from agents.runs.tracking import Tracker

POLL_SECONDS = 0.005


class Session:
    """One process's part of a run: owns its state, its files and what is shown."""

    def __init__(
        self,
        folder: RunFolder,
        run: Run,
        console: Console,
        *,
        checkpoint_every: int,
        keep: int,
        placement: Placement,
        tracker: Tracker | None = None,
        options: Sequence[str] = (),
    ):
        """Builds training and takes up the newest checkpoint.

        Args:
          folder: the run's files.
          run: what to train.
          console: where to show it.
          checkpoint_every: iterations from one checkpoint to the next.
          keep: how many checkpoints to keep.
          placement: the devices to train on; need not be that of the checkpoint.
          tracker: evaluates on further sets during training; for a single process only.
          options: command-line options to repeat when the run is continued.

        Raises:
          ValueError: the settings cannot be trained with, or the checkpoint is unusable.
        """
        self.folder, self.run, self.console = folder, run, console
        self._every, self._tracker, self._placement = checkpoint_every, tracker, placement
        self.resume_command = resume_command(folder, *options)
        self._results: futures.Future[tuple[Evaluator, report_page.Pay]] | None = None
        self._introduce()
        self._train = make_train(run.config, shards=placement.episodes)
        # Files are the first process's alone.
        is_first = processes.is_first()
        self._checkpoints = Checkpoints(folder.checkpoints, keep=keep) if is_first else None
        keys = jax.vmap(jax.random.key)(np.array(run.seed_range, np.uint32))
        init = jax.jit(jax.vmap(self._train.init))
        self._shapes = jax.eval_shape(init, keys)
        try:
            stored = processes.from_first(self._stored)
        except ValueError:
            self.close()
            raise
        arrays, self._progress = stored or (None, Progress.start(run))

        def first() -> TrainState:
            if arrays is not None:
                return placement.put(from_arrays(arrays, self._shapes))
            return placement.put(compiled(init.lower(keys), run.config)(keys))

        # Meanwhile the programs of an iteration are traced.
        self._first = in_background(first)
        self.saved = self._progress.iteration
        self._log = MetricsLog(folder.metrics, last_iteration=self.saved) if is_first else None
        if tracker is not None and self._log is not None:
            tracker.resume(self._log.rows, self.saved)

    def close(self) -> None:
        """Ends whatever works in the background."""
        if self._checkpoints is not None:
            self._checkpoints.close()

    def train(self, stop: StopSignals, *, then_finish: bool = False) -> None:
        """Trains until every seed is solved, or has come to the limit of iterations or steps.

        Args:
          stop: tells when to stop early.
          then_finish: `finish` will follow; what it needs compiles from the second iteration on.

        Raises:
          Stopped: on request; everything is saved.
          KeyboardInterrupt: on a second request; the current iteration is lost.
        """
        if not self._progress.active.any():
            return
        advance = self._compile()
        live = report.LiveReport(self.console, self.run.config.iterations, self.run.seeds)
        with stop, live:
            while self._progress.active.any():
                rows = self._iterate(advance)
                num_solved = sum(first is not None for first in self._progress.solved)
                live.update(rows, num_solved, ready_at=advance.ready_at)
                if then_finish and self._log is not None and self._results is None:
                    self._prepare_results()
                # A signal may arrive at any time: what counts is what all agreed on here.
                request = processes.agree(stop.received)
                is_over = not self._progress.active.any()
                if is_over or request or self._progress.iteration % self._every == 0:
                    self._save()
                if request:
                    raise Stopped(request)

    def finish(self) -> None:
        """Evaluates on all task sets, writes the results and says what they show."""
        run, folder = self.run, self.folder
        state = self._local_state()
        if self._log is None:
            return
        self.console.print("Evaluating on all task sets ...")
        evaluator, pay = self._ready() if self._results is None else self._results.result()
        trained = self._policies(state)
        played = {policy.name: evaluator(policy.params) for policy in trained}
        results = {name: evaluator.scores(outcome) for name, outcome in played.items()}
        write_json(folder.evaluation, report.results_json(trained, results))
        self._summarize(state, self._log)
        env = tt.task_set(run.config.env_id)
        folder.animation.unlink(missing_ok=True)
        report.save_first_solved(folder.animation, evaluator, played.values(), env.short)
        solved = dict(zip(run.seed_range, self._progress.solved, strict=True))
        above, below = story(
            folder, run, results.values(), list(solved.values()), self.resume_command
        )
        report_page.save(
            folder.page,
            title=folder.path.name,
            sentences=[*above, *below],
            settings={"preset": run.preset, **run.config.to_dict()},
            scores=results,
            curves=folder.curves,
            evaluator=evaluator,
            played=played[trained[0].name],
            pay=functools.partial(pay, jax.tree.map(lambda x: x[0], state)),
        )
        self._say(above)
        for name, result in results.items():
            table = report.evaluation_table(result, f"{folder.path.name}, {name}")
            self.console.print(table.to_rich())
        self.console.print(report.FEW_LAYOUTS)
        self.console.print(report.summary_table(solved, env.id).to_rich())
        self._say_where()
        self._say(below)

    def summarize(self) -> None:
        """Writes the summary and the learning curves."""
        state = self._local_state()
        if self._log is not None:
            self._summarize(state, self._log)

    def _stored(self) -> tuple[Any, Progress] | None:
        """The arrays of the newest checkpoint, and how far it had come."""
        if self._checkpoints is None or not self._checkpoints.iterations:
            return None
        state, record = self._checkpoints.restore(self._shapes)
        rows = read_metrics(self.folder.metrics)
        progress = Progress.resumed(record, self.run, rows)
        progress.check(self.run, np.asarray(state.iteration))
        return to_arrays(state), progress

    @functools.cached_property
    def _state(self) -> TrainState:
        """The first state, which later ones replace."""
        return self._first.result()

    def _compile(self) -> Programs:
        count = num_parameters(self._shapes.params) // self.run.seeds
        iteration = self._progress.iteration
        begin = f"from iteration {iteration}" if iteration else "from the start"
        self._say([f"{count:,} parameters, {begin}. Compiling one iteration of training ..."])
        active = np.ones(self.run.seeds, bool)
        return Programs(self._train, self._placement, self._shapes, active)

    def _prepare_results(self) -> None:
        """Compiles in the background what `finish` needs."""
        self._results = in_background(self._ready)

    def _ready(self) -> tuple[Evaluator, report_page.Pay]:
        """What plays the tasks of all sets, and what the curiosity pays for it, compiled."""
        config = self.run.config
        sets = own_and_paper_sets(config)
        evaluator = Evaluator.of_sets(config, sets, config.eval_episodes)
        state = jax.eval_shape(self._train.init, jax.random.key(0))
        evaluator.compile({part: state.params[part] for part in PARTS})
        return evaluator, report_page.compile_pay(config, state, evaluator)

    def _iterate(self, advance: Programs) -> list[Row]:
        progress, active = self._progress, self._progress.active
        started = time.perf_counter()
        self._state, metrics = advance(self._state, active)
        _wait(metrics)
        host = {name: np.asarray(values) for name, values in metrics.items()}
        compiling = max(0.0, advance.ready_at - started)  # of the first iteration alone
        taken = time.perf_counter() - started - compiling
        steps = host.pop("steps")
        iteration, seconds = progress.iteration + 1, progress.seconds + taken
        rows: list[Row] = [
            {
                "seed": seed,
                "iteration": iteration,
                **{name: values[index] for name, values in host.items()},
                "transitions_per_second": round(float(steps[index]) / taken, 1),
                "seconds": round(seconds, 3),
            }
            for index, seed in enumerate(self.run.seed_range)
            if active[index]
        ]
        progress = progress._replace(
            iteration=iteration,
            seconds=seconds,
            compile_seconds=progress.compile_seconds + compiling,
        ).after(self.run, rows)
        changes = zip(self.run.seed_range, self._progress.solved, progress.solved, strict=True)
        rows = self._track(rows, just_solved={seed for seed, old, new in changes if old != new})
        if self._log is not None:
            self._log.append(rows)
        self._progress = progress
        return rows

    def _track(self, rows: list[Row], just_solved: set[int]) -> list[Row]:
        """The rows of an iteration with what the tracker adds to them.

        A seed is evaluated when it would be if it were trained alone.
        """
        tracker = self._tracker
        if tracker is None:
            return rows
        by_seed = {int(row["seed"]): row for row in rows}
        due = set(by_seed) if tracker.is_due(int(rows[0]["iteration"])) else just_solved
        policies = self._policies(self._local_state()) if due else []
        found = {
            seed: tracker.evaluate(seed, policy)
            for seed, policy in zip(self.run.seed_range, policies, strict=bool(due))
            if seed in due
        }
        return [{**row, **found.get(seed, tracker.skip())} for seed, row in by_seed.items()]

    def _save(self) -> None:
        record = {**self._progress.to_dict(), "run": self.run.to_dict(), "version": tt.__version__}
        state = self._local_state()
        if self._checkpoints is not None:
            self._checkpoints.save(self._progress.iteration, state, record)
            if self._tracker is not None:
                self._tracker.forget(self._checkpoints.iterations[0])
        self.saved = self._progress.iteration

    def _local_state(self) -> TrainState:
        """The whole state on one device; every process has to call it."""
        return self._placement.local(self._state)

    def _policies(self, state: TrainState) -> list[Policy]:
        return policies(self.run, state.params, np.asarray(state.iteration))

    def _summarize(self, state: TrainState, log: MetricsLog) -> None:
        seeds = zip(self.run.seed_range, state.episodes, self._progress.solved, strict=True)
        summary = {
            "env_id": self.run.config.env_id,
            "iterations": self._progress.iteration,
            "training_seconds": round(self._progress.seconds, 3),
            "compile_seconds": round(self._progress.compile_seconds, 3),
            "seeds": [
                {
                    "seed": seed,
                    "episodes": int(episodes),
                    "first_solved": first and dataclasses.asdict(first),
                }
                for seed, episodes, first in seeds
            ],
        }
        write_json(self.folder.summary, summary)
        report.save_curves(log.rows, self.folder.curves, self.folder.path.name)

    def _introduce(self) -> None:
        run = self.run
        seeds = ", ".join(map(str, run.seed_range))
        self._say(
            [
                f"{self.folder.path}: preset {run.preset}, {tt.task_set(run.config.env_id).id}, "
                f"curiosity {run.config.curiosity}, seed {seeds}, on {self._placement}"
            ]
        )

    def _say(self, lines: Sequence[str]) -> None:
        for line in lines:
            self.console.print(line, soft_wrap=True, highlight=False)

    def _say_where(self) -> None:
        folder = self.folder
        files = {
            "settings": folder.config,
            "metrics": folder.metrics,
            "checkpoints": folder.checkpoints,
            "learning curves": folder.curves,
            "evaluation": folder.evaluation,
            "summary": folder.summary,
            "report": folder.page,
        }
        self._say([f"{name:>15}: {path}" for name, path in files.items()])


def _wait(arrays: Any) -> None:
    """Blocks until the arrays are there, but lets signals through."""
    while not all(x.is_ready() for x in jax.tree.leaves(arrays)):
        time.sleep(POLL_SECONDS)
