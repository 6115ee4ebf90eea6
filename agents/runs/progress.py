"""The files and the progress of one run: rows, checkpoints, best policy, evaluations, report."""

import contextlib
from collections.abc import Callable

import numpy as np
from rich.console import Console

import trap_tube_jax as tt
from agents.acting.policy import Policy
from agents.networks.agent import PARTS
from agents.ppo.learner import TrainState
from agents.runs import checkpoint, report
from agents.runs.display import TrainingLine
from agents.runs.evaluator import Evaluator
from agents.runs.folder import RunFolder
from agents.runs.history import best_iteration, check_rows, restore
from agents.runs.loading import load, read_policy, save
from agents.runs.loggers import open_loggers
from agents.runs.metrics import Row, append_rows, evaluation_rows, is_last, read_rows, rewind_rows
from agents.runs.program import Metrics, Program
from agents.runs.provenance import note_provenance
from agents.runs.run import Run, check_continues


class Progress:
    """One run as far as it has come, and the writer of its files.

    Attributes:
      state: returns the current training state. Training replaces the function.
      last: the newest row of metrics; None before the first iteration.
      start: the agent to fine-tune, of a new run; else None.
    """

    def __init__(
        self, run: Run, program: Program, stored: RunFolder, folder: RunFolder, console: Console
    ):
        """Reads the newest checkpoint of `stored` and checks the files; writes nothing.

        Args:
          run: the run.
          program: what the run shares with others.
          stored: the run's folder.
          folder: the folder to write to; see `session.output_folder`.
          console: where progress is shown.

        Raises:
          ValueError: the run cannot be continued, or files contradict one another.
          OSError: a file cannot be read.
        """
        self.run = run
        self.program = program
        self.console = console
        self.stored = stored
        self.folder = folder
        self.has_trained = False
        if stored.config.is_file():
            check_continues(stored.path, stored.read(), (run, program.options))
        restored, self.last = restore(stored, program.state_shapes)
        done = self.iteration
        if done > (limit := run.config.iterations):
            raise ValueError(f"iterations must be at least {done}, which are done, got {limit}")
        self.train_set = tt.task_set(run.config.env_id).short
        check_rows(stored, done, self.train_set)
        self.start: Policy | None = None
        if restored is None and run.finetune is not None:
            source = stored.start if stored.start.is_file() else run.finetune
            self.start = load(source)
        first = program.init(run.seed, self.start) if restored is None else restored
        self.state: Callable[[], TrainState] = lambda: first

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self.last["iteration"] if self.last else 0

    @property
    def is_trained(self) -> bool:
        """True if training has reached a limit."""
        return self.last is not None and is_last(self.last, self.run.config)

    def begin(self) -> None:
        """Writes config.json and, for a new run, the agent to fine-tune and the first checkpoint.

        Removes rows after the newest checkpoint.
        """
        self.folder.write_config(self.run, self.program.options)
        if self.start is not None:
            save(self.folder.start, self.start)
        if self.last is None:
            self.save()  # from now on, rows without a checkpoint mean that files were removed
        for rows in (self.folder.metrics, self.folder.evaluations):
            rewind_rows(rows, self.iteration)
        if self.program.validation:
            self._keep_best()  # a kill may have come between checkpoint and best policy

    def begin_training(self, stack: contextlib.ExitStack, seeds: int) -> None:
        """Opens loggers and progress line until the end of `stack`, and says what is trained.

        `seeds` are trained together.
        """
        self.has_trained = True
        config = self.run.config
        options = self.program.options
        note_provenance(self.folder.provenance, str(self.program.placement))
        chosen = {"tensorboard": options.tensorboard, "wandb": options.wandb}
        self._log = stack.enter_context(open_loggers(self.folder.path, self.run, **chosen))
        self._line = stack.enter_context(TrainingLine(self.console, config.iterations))
        together = f", with {seeds - 1} other seed(s)" if seeds > 1 else ""
        train_set = tt.task_set(config.env_id).label
        origin = "" if self.run.finetune is None else f", fine-tuned from {self.run.finetune}"
        self.console.out(
            f"{self.folder.path}: {train_set}, curiosity {config.curiosity}, "
            f"seed {self.run.seed}, {self.program.num_parameters:,} parameters{origin}\n"
            f"On {self.program.placement}, {self.program.learner.encoding.name} path{together}. "
            "Compiling, which takes up to a minute ..."
        )

    def record(self, metrics: Metrics, seconds: float) -> None:
        """Writes an iteration's row of metrics; evaluates and saves where it is due.

        Args:
          metrics: by `program.make_advance`.
          seconds: the run's share of the wall time of the iteration.

        Raises:
          ValueError: a loss or a gradient is not finite.
        """
        options = self.program.options
        row = self._row(metrics, seconds)
        append_rows(self.folder.metrics, [row])
        self.last = row
        due = options.evaluate_every and self.iteration % options.evaluate_every == 0
        if self.program.validation and (due or self.is_trained):
            self._validate(self.program.validation)
        self._log(row)
        self._line.show(row)
        if self.iteration % options.checkpoint_every == 0 or self.is_trained:
            self.save()
        if self.is_trained:  # other seeds of the program may go on
            last = self.state()
            self.state = lambda: last

    def save(self) -> None:
        """Saves a checkpoint."""
        state = self.program.placement.local(self.state())
        checkpoint.save(self.folder.checkpoints, self.iteration, state, dict(self.last or {}))

    def finish(self) -> tt.Scores | None:
        """Plays the test tasks with the final policy, or the best one; writes the results.

        Returns the scores, or None if the files already hold the scores and the report.
        """
        options = self.program.options
        policy = self._policy()
        if self.stored.best.is_file():
            policy = read_policy(self.stored.best)
        tested = read_rows(self.stored.evaluations).query("purpose == 'test'")["iteration"]
        is_tested = policy.iteration in set(tested)
        has_page = self.folder.page.exists() or not options.report
        if is_tested and has_page and not self.has_trained:
            self.console.out("Already tested; to play other tasks, run python -m agents.evaluate.")
            return None
        self.console.out("Playing test tasks, which takes up to a minute ...")
        evaluator = self.program.test
        played = evaluator(policy.params)
        scores = evaluator.suite.scores(played)
        if options.report:
            self.folder.page.unlink(missing_ok=True)  # from now on it shows other scores
        if not is_tested:
            append_rows(self.folder.evaluations, evaluation_rows(scores, policy, "test"))
        self.console.out(scores)
        if options.report:  # last, since a figure may fail
            self.console.out("Drawing the report, which takes up to half a minute ...")
            report.write(self.folder, self.run, evaluator.suite, played)
        return scores

    def _row(self, metrics: Metrics, seconds: float) -> Row:
        """Returns a row of metrics; `seconds` is the run's share of the time of the iteration."""
        iteration = self.iteration + 1
        config = self.run.config
        # Computed before the first gradient step, with parameters that were finite.
        if not np.isfinite(metrics["intrinsic_reward"]):
            raise ValueError(
                f"curiosity {config.curiosity!r} returned a reward that is not finite in "
                f"iteration {iteration}"
            )
        # A parameter is infinite or NaN only if the norm of a gradient is.
        if not all(np.isfinite(metric).all() for metric in metrics.values()):
            raise ValueError(
                f"training diverged in iteration {iteration}: a loss or a gradient is not "
                f"finite; try a learning_rate below {config.learning_rate:g}"
            )
        shares = {name: metric.mean() for name, metric in metrics.items() if metric.ndim}
        numbers = {**metrics, **shares}  # means in float64, to compare with thresholds
        steps = numbers.pop("steps")
        before = self.last["seconds"] if self.last else 0.0
        return {
            "iteration": iteration,
            **{name: numbers[name].item() for name in sorted(numbers)},
            "transitions_per_second": round(float(steps) / seconds, 1),
            "seconds": round(before + seconds, 3),
        }

    def _validate(self, evaluator: Evaluator) -> None:
        policy = self._policy()
        scores = evaluator.suite.scores(evaluator(policy.params))
        append_rows(self.folder.evaluations, evaluation_rows(scores, policy, "validation"))
        self._keep_best()

    def _keep_best(self) -> None:
        """Saves the current policy if no earlier one was evaluated as well."""
        rows = read_rows(self.folder.evaluations)
        if best_iteration(rows, self.train_set) == self.iteration:
            self.save()  # first, or a resume could start before the best policy
            save(self.folder.best, self._policy())

    def _policy(self) -> Policy:
        state = self.state()
        params = {part: state.params[part] for part in PARTS}
        return Policy(self.run.config, self.program.placement.local(params), self.iteration)
