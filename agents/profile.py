"""Generalisation profiles from the command line: python -m agents.profile --help."""

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from agents.acting.policy import Policy
from agents.command_line import Imports
from agents.experiments.records import check_clean, read_record
from agents.pretrained import load_shipped
from agents.profiles import figures, tables
from agents.profiles.measure import SCHEMA, Settings, profile
from agents.runs import compilation
from agents.runs.folder import RunFolder, read_json, write_json
from agents.runs.loading import load_policy
from trap_tube_jax.command_line import plain_errors
from trap_tube_jax.imports import import_modules

PROGRAM = "python -m agents.profile"


@dataclasses.dataclass(frozen=True)
class Options(Settings):
    """Profiles trained agents: how success falls with the distance from the base task.

    Percent solved and optimality against the angle of the colours, the distance of the layout,
    the length of the shortest plan, by the way that the food has to take, and by kind of symbolic
    swap; the controls of comparative psychology; the paired test of the first push; and at which
    step and subgoal plans go wrong. All agents in one figure, and one more figure for each.
    Greedy play on tasks drawn with keys that training never uses, compared with exact shortest
    plans.

    Attributes:
      runs: folders of runs, or files of parameters; of a run its first seed.
      pretrained: names of shipped parameters.
      imports: modules of your own to import first, for what the agents' settings name; those of
        the runs are known.
      out: the folder of record, tables and figures.
      record: also write the record to this file; refused unless all is of committed code.
      commit: the commit to note where git does not tell it.
      draw: measure nothing; draw tables and figures of this record.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    pretrained: tuple[str, ...] = ()
    imports: Imports = ()
    out: Path = Path("runs/profile")
    record: Path | None = None
    commit: str | None = None
    draw: Path | None = None

    def policies(self) -> dict[str, Policy]:
        """What to profile, by the name that figures show.

        Raises:
          ValueError: nothing is given, two have one name, or one cannot be read.
        """
        if not self.runs and not self.pretrained:
            raise ValueError("give runs' folders or --pretrained NAME, one or more of them")
        names = [*(path.resolve().name for path in self.runs), *self.pretrained]
        if len(set(names)) < len(names):
            raise ValueError(
                "two agents have the same name, by which figures tell them apart: "
                f"{', '.join(names)}; rename one folder or file"
            )
        found = [*map(load_policy, self.runs), *map(load_shipped, self.pretrained)]
        return dict(zip(names, found, strict=True))

    def machines(self) -> list[Any]:
        """Those that the runs were trained on."""
        return [each for path in self.runs for each in read_json(RunFolder(path).machines) or ()]


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    with plain_errors():
        options = tyro.cli(Options, args=arguments, prog=PROGRAM)
        compilation.enable_cache()
        run(options, arguments)


def without_places(arguments: Sequence[str]) -> list[str]:
    """The arguments but --out and --record: where results go says nothing of them."""
    kept, given = [], iter(arguments)
    for argument in given:
        name, _, value = argument.partition("=")
        if name not in ("--out", "--record"):
            kept.append(argument)
        elif not value:
            next(given, None)
    return kept


def run(options: Options, arguments: Sequence[str]) -> None:
    """Measures as the options say, and shows and writes the results.

    Raises:
      ValueError: an option is not allowed, or a record cannot be read or written.
    """
    console = Console()
    import_modules(options.imports)
    drawn = None if options.draw is None else read_record(options.draw, SCHEMA)
    if options.record is not None:  # before measuring, which would be in vain
        check_clean(drawn or {"machines": options.machines()}, options.commit)
    found = drawn or profile(
        options.policies(),
        options,
        console,
        command=f"{PROGRAM} {shlex.join(without_places(arguments))}",
        machines=options.machines(),
        commit=options.commit,
    )
    for table in tables.tables(found):
        console.print(table.to_rich())
    write_json(options.out / "profile.json", found)
    text = f"# Profile\n\n{tables.markdown(found)}\n"
    (options.out / "tables.md").write_text(text, encoding="utf-8")
    for name, save in figures.drawings(found, "profile").items():
        save(options.out / name)
    console.print(f"record, tables and figures: {options.out}", soft_wrap=True, highlight=False)
    if options.record is not None:
        check_clean(found, options.commit)
        write_json(options.record, found)
        console.print(f"record: {options.record}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main()
