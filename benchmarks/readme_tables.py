"""The tables and figures of all pages, from the records alone: python -m benchmarks.readme_tables.

A record is `benchmarks/results/NAME.json`, which `python -m agents.experiments --record`
and `python -m agents.profile --record` write. In any Markdown page of the project the text between
`<!-- table: NAME -->` and `<!-- end -->` is the tables of that record; its figures are
`benchmarks/results/figures/NAME.png`, and of a profile `NAME_AGENT.png` beside it. A block or a
figure whose record is not there is left as it is.
"""

import dataclasses
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import tyro

import agents.profiles.figures
import agents.profiles.tables
from agents.experiments import figures, tables
from agents.experiments.records import SCHEMA, Record, read_record
from agents.profiles import measure
from benchmarks import harness
from trap_tube_jax.command_line import Flag, plain_errors

ROOT = Path(__file__).parent.parent
PAGES = ("*.md", "agents/**/*.md", "benchmarks/**/*.md", "trap_tube_jax/**/*.md")
# By schema, what makes the tables and what draws the figures of a record.
KINDS = {
    SCHEMA: (tables, figures),
    measure.SCHEMA: (agents.profiles.tables, agents.profiles.figures),
}
BLOCK = re.compile(r"(?P<start><!-- table: (?P<name>\S+) -->\n).*?(?P<end><!-- end -->)", re.DOTALL)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Names the pages and figures that are not what their records make of them.

    Ends with 1 if there are any.

    Attributes:
      write: bring them up to date instead.
      root: the folder of the project.
    """

    write: Flag = False
    root: Path = ROOT

    @property
    def results(self) -> Path:
        """The folder of the records."""
        return self.root / "benchmarks" / "results"


def read_records(results: Path) -> dict[str, Record]:
    """The records of a folder that have tables, by name.

    Raises:
      ValueError: a JSON file is no record, or of another schema than this version's.
    """
    paths = sorted(results.glob("*.json"))
    records = {path.stem: read_record(path, *KINDS, harness.SCHEMA) for path in paths}
    return {name: record for name, record in records.items() if record["schema"] in KINDS}


def generate(text: str, records: dict[str, Record]) -> str:
    """The text of a page with the block of every record made anew."""

    def fill(match: re.Match[str]) -> str:
        record = records.get(match["name"])
        if record is None:
            return match[0]
        own_tables, _ = KINDS[record["schema"]]
        return f"{match['start']}\n{own_tables.markdown(record)}\n\n{match['end']}"

    return BLOCK.sub(fill, text)


def stale(root: Path, records: dict[str, Record]) -> dict[Path, Callable[[], object]]:
    """The files that differ from what the records make of them, with what rewrites each."""
    found: dict[Path, Callable[[], object]] = {}
    for path in sorted(path for pattern in PAGES for path in root.glob(pattern)):
        text = path.read_text(encoding="utf-8")
        made = generate(text, records)
        if made != text:
            found[path] = partial(path.write_text, made, encoding="utf-8")
    for name, record in records.items():
        _, own_figures = KINDS[record["schema"]]
        for file, draw in own_figures.drawings(record, name).items():
            path = root / "benchmarks" / "results" / "figures" / file
            if figures.drawn_from(path) != figures.digest(record):
                found[path] = partial(draw, path)
    return found


def main(arguments: Arguments) -> None:
    """Compares, writes if asked to, and exits with 1 if it finds what is out of date."""
    with plain_errors():
        records = read_records(arguments.results)
    found = stale(arguments.root, records)
    for path, rewrite in found.items():
        if arguments.write:
            rewrite()
        print(f"{'written' if arguments.write else 'out of date'}: {path}")
    print(f"records: {', '.join(records) or 'none'}")
    if found and not arguments.write:
        print("give --write to bring these files up to date")
        raise SystemExit(1)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
