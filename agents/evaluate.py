"""Evaluation from the command line: python -m agents.evaluate --help."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

import trap_tube_jax as tt
from agents.command_line import option, parse
from agents.runs import compilation
from agents.runs.evaluator import Evaluator, default_sets
from agents.runs.folder import check_output
from agents.runs.loading import load
from agents.runs.metrics import evaluation_rows, write_rows
from agents.runs.report import save_first_solved
from trap_tube_jax.command_line import announce, plain_errors
from trap_tube_jax.interruptions import run_command
from trap_tube_jax.scoring.tasks import Purpose


@dataclasses.dataclass(frozen=True)
class Options:
    """Evaluates a trained agent greedily, on fixed tasks drawn with keys that training never draws.

    Attributes:
      source: a run's folder, a file of parameters, or the name of a shipped agent.
      sets: ids or short names of task sets, by default the paper's eight and the training set.
      imports: modules to import first, which register curiosities, encoders or task sets.
      tasks: tasks per set, by default the run's `eval_episodes`. Base has one.
      purpose: which fixed tasks to play: `test`, or those for selection or for a final
        confirmation.
      iteration: checkpoint to load, by default the best policy, or the newest checkpoint if none
        was selected.
      optimality: finds shortest plans first, and compares with them.
      output: CSV file for the results.
      gif: GIF file for the first solved episode.
    """

    source: str
    sets: tuple[str, ...] = ()
    imports: tuple[str, ...] = option((), append=True, flags=("--import",))
    tasks: int | None = None
    purpose: Purpose = "test"
    iteration: int | None = None
    optimality: bool = False
    output: Path | None = None
    gif: Path | None = None


@plain_errors()
def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    options = parse(Options, arguments, "python -m agents.evaluate")
    for path in filter(None, (options.output, options.gif)):
        check_output(path)
    compilation.enable_cache()
    policy = load(options.source, iteration=options.iteration, imports=options.imports)
    config = policy.config
    tasks = config.eval_episodes if options.tasks is None else options.tasks
    sets = options.sets or default_sets(config)
    evaluator = Evaluator.of_sets(config, sets, tasks, options.purpose)
    # An unknown training set is refused before anything is played.
    train_set = tt.task_set(config.env_id).short if options.gif else ""
    shortest = None
    if options.optimality:
        announce("Searching for shortest plans, up to a minute per 1,000 tasks")
        shortest = {
            name: tt.solve_batch(drawn).length for name, drawn in evaluator.suite.tasks.items()
        }
    announce(f"Playing {tasks:,} tasks of every set, up to a minute per 1,000")
    played = evaluator(policy.params)
    scores = evaluator.suite.scores(played, shortest=shortest)
    title = f"{options.source}, iteration {policy.iteration}, {options.purpose} tasks"
    print(title, scores, sep="\n\n", flush=True)
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        table = pd.DataFrame(evaluation_rows(scores, policy, options.purpose))
        table.insert(0, "policy", options.source)
        write_rows(options.output, table)
        print(f"\nresults: {options.output}")
    if options.gif is not None:
        options.gif.parent.mkdir(parents=True, exist_ok=True)
        shown = save_first_solved(options.gif, evaluator.suite, played, train_set)
        print(f"\nsolved episode of {shown}: {options.gif}" if shown else "\nnothing is solved")


if __name__ == "__main__":
    run_command(main)
