"""Generalisation profiles from the command line: python -m agents.profile --help."""

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from agents.command_line import option, parse
from agents.files import write_json
from agents.profiles import plots
from agents.profiles.measure import failure_table, profile, success_table
from agents.profiles.tasks import PARTS, STRENGTHS
from agents.runs import compilation
from agents.runs.loading import load
from agents.runs.provenance import provenance
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.interruptions import run_command


@dataclasses.dataclass(frozen=True)
class Options:
    """Profiles trained agents: success by distance from the base task and by kind of task.

    Agents play greedily, one episode a task, on tasks drawn with keys that training never uses.
    Writes profile.csv, provenance.json and, if their parts are measured, success.png and
    controls.png.

    Attributes:
      runs: runs' folders, files of parameters, or names of shipped agents.
      output: folder for the files.
      parts: some of structural, perceptual and both (success by strength), symbolic (by swapped
        object), kind and plan-length (of the tasks of {P}) and control.
      strengths: strengths of the graded transfers, from 0 (base) to 1 (the paper's transfer).
      tasks: tasks of each strength, each symbolic swap, and {P}.
      imports: modules to import first, which register names in an agent's settings.
    """

    runs: tuple[str, ...]
    output: Path = Path("runs/profile")
    parts: tuple[str, ...] = tuple(PARTS)
    strengths: tuple[float, ...] = STRENGTHS
    tasks: int = 200
    imports: tuple[str, ...] = option((), append=True, flags=("--import",))


@plain_errors()
def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    options = parse(Options, arguments, "python -m agents.profile")
    compilation.enable_cache()
    policies = {str(Path(x)): load(x, imports=options.imports) for x in options.runs}
    origin = {
        "command": f"python -m agents.profile {shlex.join(arguments)}",
        "iterations": {name: policy.iteration for name, policy in policies.items()},
        **provenance(),
    }
    options.output.mkdir(parents=True, exist_ok=True)
    found = profile(policies, options.parts, options.strengths, options.tasks)
    found.to_csv(options.output / "profile.csv", index=False, float_format="%.6g")
    write_json(options.output / "provenance.json", origin)
    if set(options.parts) & set(plots.PANELS):
        plots.save_success(found, options.output / "success.png")
    if "control" in options.parts:
        plots.save_controls(found, options.output / "controls.png")
    print(f"Tasks solved, %\n\n{success_table(found).to_string()}\n")
    print(f"Failed episodes, by last subgoal reached\n\n{failure_table(found).to_string()}\n")
    print(f"results: {options.output}")


if __name__ == "__main__":
    run_command(main)
