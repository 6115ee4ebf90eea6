"""Evaluation from the command line: python -m agents.evaluate --help."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

import trap_tube_jax as tt
from agents.acting.evaluation import Evaluator, own_and_paper_sets
from agents.acting.policy import Policy
from agents.command_line import Flag, Imports
from agents.pretrained import load_shipped
from agents.runs import compilation, report
from agents.runs.folder import write_json
from agents.runs.loading import load_policies
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import import_modules
from trap_tube_jax.solver import solve_batch


@dataclasses.dataclass(frozen=True)
class Options:
    """Evaluates a trained agent greedily, on fixed tasks drawn with keys that training never draws.

    Attributes:
      run: a run's folder, a file of parameters, or the name of shipped ones.
      pretrained: the name of shipped parameters, instead of a run.
      sets: ids or short names of task sets; the paper's eight, and that of training, if absent.
      imports: modules of your own to import first, for the sets that they register; those of
        the run are known.
      tasks: how many per set; the run's `eval_episodes` if absent. The base set has one.
      iteration: the checkpoint to evaluate; the newest if absent.
      gif: write the first solved episode to this file.
      json: write the results to this file.
      optimality: compare with shortest plans, which are searched for first.
    """

    run: Annotated[Path | None, tyro.conf.Positional] = None
    pretrained: str | None = None
    sets: tuple[str, ...] | None = None
    imports: Imports = ()
    tasks: int | None = None
    iteration: int | None = None
    gif: Path | None = None
    json: Path | None = None
    optimality: Flag = False

    def policies(self) -> list[Policy]:
        """What to evaluate.

        Raises:
          ValueError: it is not given, given twice, or cannot be read.
        """
        if (self.run is None) == (self.pretrained is None):
            raise ValueError("give a run's folder or --pretrained NAME, one of them")
        if self.run is not None:
            return load_policies(self.run, self.iteration)
        if self.iteration is not None:
            raise ValueError("--iteration names a checkpoint of a run: --pretrained has none")
        return [load_shipped(str(self.pretrained))]


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    options = tyro.cli(Options, args=arguments, prog="python -m agents.evaluate")
    compilation.enable_cache()
    with plain_errors():
        evaluate(options)


def evaluate(options: Options) -> None:
    """Evaluates as the options say, and shows and writes the results.

    Raises:
      ValueError: an option is not allowed, or there is nothing to evaluate.
    """
    import_modules(options.imports)
    policies = options.policies()
    config = policies[0].config
    sets = own_and_paper_sets(config) if options.sets is None else options.sets
    tasks = config.eval_episodes if options.tasks is None else options.tasks
    evaluator = Evaluator.of_sets(config, sets, tasks)
    shortest = None
    if options.optimality:
        shortest = {name: solve_batch(drawn).length for name, drawn in evaluator.tasks.items()}
    played = {policy.name: evaluator(policy.params) for policy in policies}
    results = {name: evaluator.scores(outcome, shortest) for name, outcome in played.items()}
    console = Console()
    source = "pretrained" if options.run is None else options.run.resolve().name
    for policy in policies:
        title = f"{source}, {policy.name}, iteration {policy.iteration}"
        console.print(report.evaluation_table(results[policy.name], title).to_rich())
        if options.optimality:
            console.print(report.optimality_table(results[policy.name], title).to_rich())
    if any(score.layouts for result in results.values() for score in result):
        console.print(report.FEW_LAYOUTS)
    if options.json is not None:
        write_json(options.json, report.results_json(policies, results))
        console.print(f"results: {options.json}", soft_wrap=True)
    if options.gif is not None:
        prefer = tt.task_set(config.env_id).short
        options.gif.parent.mkdir(parents=True, exist_ok=True)
        shown = report.save_first_solved(options.gif, evaluator, played.values(), prefer)
        message = f"solved episode of {shown}: {options.gif}" if shown else "no episode is solved"
        console.print(message, soft_wrap=True)


if __name__ == "__main__":
    main()
