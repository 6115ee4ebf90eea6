"""The tables and figures of all pages, from the records alone: python -m benchmarks.readme_tables.

A record is `benchmarks/results/NAME.json`, which `python -m agents.experiments --record`
writes. In any Markdown page of the project the text between `<!-- table: NAME -->` and
`<!-- end -->` is the tables of that record; `benchmarks/results/figures/NAME.png` is its figure.
A block or a figure whose record is not there is left as it is.
"""

import dataclasses
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from agents.experiments import figures, tables
from agents.experiments.records import Record, is_record, read_record

ROOT = Path(__file__).parent.parent
PAGES = ("*.md", "agents/**/*.md", "benchmarks/**/*.md", "trap_tube_jax/**/*.md")
BLOCK = re.compile(r"(?P<start><!-- table: (?P<name>\S+) -->\n).*?(?P<end><!-- end -->)", re.DOTALL)

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Names the pages and figures that are not what their records make of them.

    Ends with 1 if there are any. That is also what --check asks for, the default.

    Attributes:
      write: bring them up to date instead.
      check: write nothing.
      root: the folder of the project.
    """

    write: Flag = False
    check: Flag = False
    root: Path = ROOT

    def __post_init__(self) -> None:
        """Checks that one thing is asked for.

        Raises:
          ValueError: both --write and --check are given.
        """
        if self.write and self.check:
            raise ValueError("--write and --check exclude each other; give one")

    @property
    def results(self) -> Path:
        """The folder of the records."""
        return self.root / "benchmarks" / "results"


def read_records(results: Path) -> dict[str, Record]:
    """All records of a folder by name; other JSON files are none.

    Raises:
      ValueError: a record is of another schema than this version's.
    """
    paths = [path for path in sorted(results.glob("*.json")) if is_record(path)]
    return {path.stem: read_record(path) for path in paths}


def generate(text: str, records: dict[str, Record]) -> str:
    """The text of a page with the block of every record made anew."""

    def fill(match: re.Match[str]) -> str:
        record = records.get(match["name"])
        if record is None:
            return match[0]
        return f"{match['start']}\n{tables.markdown(record)}\n\n{match['end']}"

    return BLOCK.sub(fill, text)


def stale(root: Path, records: dict[str, Record]) -> dict[Path, Callable[[], object]]:
    """The files that differ from what the records make of them, with what rewrites each."""
    found: dict[Path, Callable[[], object]] = {}
    for path in sorted(path for pattern in PAGES for path in root.glob(pattern)):
        text = path.read_text()
        made = generate(text, records)
        if made != text:
            found[path] = lambda path=path, made=made: path.write_text(made)
    for name, record in records.items():
        path = root / "benchmarks" / "results" / "figures" / f"{name}.png"
        if figures.drawn_from(path) != figures.digest(record):
            found[path] = lambda path=path, record=record: _draw(record, path)
    return found


def main(arguments: Arguments) -> None:
    """Compares, writes if asked to, and exits with 1 if it finds what is out of date."""
    try:
        records = read_records(arguments.results)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    found = stale(arguments.root, records)
    for path, rewrite in found.items():
        if arguments.write:
            rewrite()
        print(f"{'written' if arguments.write else 'out of date'}: {path}")
    print(f"records: {', '.join(records) or 'none'}")
    if found and not arguments.write:
        print("give --write to bring these files up to date")
        raise SystemExit(1)


def _draw(record: Record, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figures.save(record, path)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
