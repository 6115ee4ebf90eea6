"""Generalisation profiles from the command line: python -m agents.profile --help."""

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from agents.command_line import option, parse
from agents.files import check_folder, read_json, write_bytes, write_json
from agents.profiles import plots
from agents.profiles.measure import (
    Table,
    control_table,
    knowledge_table,
    profile,
    success_table,
)
from agents.profiles.tasks import FIRST_TRIES, PARTS, STRENGTHS
from agents.runs import compilation
from agents.runs.folder import PROVENANCE_FILE
from agents.runs.loading import load, short_name
from agents.runs.provenance import provenance
from trap_tube_jax.command_line import announce, plain_errors
from trap_tube_jax.interruptions import run_command

TABLE = "profile.csv"
FIGURES = ("success.png", "controls.png")


@dataclasses.dataclass(frozen=True)
class Options:
    """Profiles trained agents: success by kind of task, and knowledge of the trap and tool.

    Agents play greedily, one episode per task, on tasks drawn with keys that training never uses.
    Writes profile.csv, provenance.json and, if their parts are measured, success.png and
    controls.png. Takes a few minutes.

    Attributes:
      runs: runs' folders, files of parameters, or names of shipped agents.
      output: folder for the files, by default runs/profile-NAMES. An earlier profile of these
        policies is replaced.
      parts: some of structural, perceptual and both (success by strength), symbolic (by the object
        that is the tool), kind and plan-length (of the tasks of {P}), first-push-p and
        first-push-pst (towards the exit or away from it, in {P} and {P, St}), first-grasp-psy and
        first-grasp-pstsy (of the tool or another object, in {P, Sy} and {P, St, Sy}) and control
        (from every cell where the agent may start).
      strengths: strengths of the graded transfers, from 0 (base) to 1 (the paper's transfer).
      tasks: number of tasks for each strength and symbolic swap, and for each set drawn.
      imports: modules to import first, which register names in an agent's settings.
    """

    runs: tuple[str, ...]
    output: Path | None = None
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
    iterations = {name: policy.iteration for name, policy in policies.items()}
    command = f"python -m agents.profile {shlex.join(arguments)}"
    origin = {"command": command, "iterations": iterations, **provenance()}
    names = "+".join(map(short_name, policies))
    output = options.output or Path("runs", f"profile-{names}")
    check_folder(output)
    if output.is_dir() and any(output.iterdir()) and not (output / TABLE).is_file():
        raise ValueError(f"{output} holds other files than a profile's; give another --output")
    before = output / PROVENANCE_FILE
    if before.is_file() and read_json(before)["iterations"].keys() != iterations.keys():
        raise ValueError(f"{output} holds the profile of other policies; give another --output")
    found = profile(policies, options.parts, options.strengths, options.tasks, announce)
    _print_tables(found)
    output.mkdir(parents=True, exist_ok=True)
    for figure in FIGURES:  # of an earlier profile
        (output / figure).unlink(missing_ok=True)
    table = found.to_csv(index=False, float_format="%.6g")
    write_bytes(output / TABLE, table.encode())
    write_json(output / PROVENANCE_FILE, origin)
    if set(options.parts) & set(plots.PANELS):
        plots.save_success(found, output / "success.png")
    if "control" in options.parts:
        plots.save_controls(found, output / "controls.png")
    print(f"results: {output}")


def _print_tables(found: Table) -> None:
    """Prints the tables of the measured parts."""
    parts = set(found["part"])
    tables = {}
    if parts - set(FIRST_TRIES):
        tables["Tasks solved, % [95 % interval]"] = success_table(found)
    if "control" in parts:
        tables["Controls solved directly, % [95 % interval]"] = control_table(found)
    if parts & set(FIRST_TRIES):
        title = "First pushes where the food could go either way, and first grasps"
        tables[title] = knowledge_table(found)
    for title, table in tables.items():
        print(f"{title}\n\n{table.to_string(line_width=80)}\n")


if __name__ == "__main__":
    run_command(main)
