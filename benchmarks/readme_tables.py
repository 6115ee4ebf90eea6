"""The tables and figures of all pages, from the records alone: python -m benchmarks.readme_tables.

A record is `benchmarks/results/NAME.json`, which `python -m agents.experiments --record`,
`python -m agents.profile --record` and the benchmarks' `--json` write. In any Markdown page of
the project they make

    <!-- table: NAME -->           up to `<!-- end -->`, all tables of the record
    <!-- table: NAME/VIEW -->      one table, in another form; see `VIEWS`
    <!-- table: NAME,NAME/VIEW --> one table of several records
    <!-- row: NAME -->             at the end of a row's first cell, the other cells: those of
                                   the leaderboard, means over all seeds
    <!-- row: NAME/SEED -->        the same of one seed

A record's figures are `benchmarks/results/figures/NAME.png`, and of a profile `NAME_AGENT.png`
beside it. They are out of date where the record or the code that draws them has changed.
"""

import dataclasses
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import tyro

import agents.profiles.figures
import agents.profiles.tables
import benchmarks.tables
from agents.command_line import Flag
from agents.experiments import figures, tables
from agents.experiments.records import SCHEMA, Record, read_record
from agents.profiles import measure
from benchmarks import harness, scaling

ROOT = Path(__file__).parent.parent
PAGES = ("*.md", "agents/**/*.md", "benchmarks/**/*.md", "trap_tube_jax/**/*.md")
SCHEMAS = (SCHEMA, measure.SCHEMA, harness.SCHEMA)
# By schema or benchmark, then by view, what makes the text; "" is the view of all tables.
VIEWS: dict[str, dict[str, Callable[..., str]]] = {
    SCHEMA: {"": tables.markdown, "summary": tables.summary_markdown},
    measure.SCHEMA: {"": agents.profiles.tables.markdown},
    "env_throughput": {"speeds": benchmarks.tables.speeds},
    "peers": {"speeds": benchmarks.tables.speeds},
    "scaling": {"points": benchmarks.tables.points},
    "scaling_model": {"speed_up": benchmarks.tables.speed_up},
}
# By schema or benchmark, what draws the figures.
FIGURES = {SCHEMA: figures, measure.SCHEMA: agents.profiles.figures, "scaling": scaling}
BLOCK = re.compile(
    r"(?P<start><!-- table: (?P<names>[^\s/]+)/?(?P<view>\S*) -->\n).*?(?P<end><!-- end -->)",
    re.DOTALL,
)
ROW = re.compile(
    r"^(?P<start>\|[^|\n]*<!-- row: (?P<name>[^\s/]+)/?(?P<seed>\d*) --> \|).*$", re.MULTILINE
)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Names the pages and figures that are not what their records make of them.

    Ends with 1 if there are any, or if a page asks for a record that is not there.

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
    """All records of a folder, by name.

    Raises:
      ValueError: a JSON file is no record, or of another schema than this version's.
    """
    return {path.stem: read_record(path, *SCHEMAS) for path in sorted(results.glob("*.json"))}


def generate(text: str, records: Mapping[str, Record]) -> str:
    """The text of a page with every block and row of a record made anew.

    Raises:
      ValueError: there is no such record, view or seed.
    """

    def block(match: re.Match[str]) -> str:
        own = [_named(records, name) for name in match["names"].split(",")]
        make, *_ = (_view(record, match["view"]) for record in own)
        return f"{match['start']}\n{make(*own)}\n\n{match['end']}"

    def row(match: re.Match[str]) -> str:
        seed = int(match["seed"]) if match["seed"] else None
        cells = tables.leaderboard_cells(_named(records, match["name"]), seed)
        return f"{match['start']} {' | '.join(cells)} |"

    return ROW.sub(row, BLOCK.sub(block, text))


def _named(records: Mapping[str, Record], name: str) -> Record:
    if name not in records:
        raise ValueError(f"there is no record {name!r}; allowed: {', '.join(records) or 'none'}")
    return records[name]


def _kind(record: Record) -> str:
    return record.get("benchmark", record["schema"])


def _view(record: Record, view: str) -> Callable[..., str]:
    views = VIEWS.get(_kind(record), {})
    if view not in views:
        allowed = ", ".join(map(repr, views)) or "none"
        raise ValueError(f"this record has no view {view!r}; allowed: {allowed}")
    return views[view]


def stale(root: Path, records: dict[str, Record]) -> dict[Path, Callable[[], object]]:
    """The files that differ from what the records make of them, with what rewrites each.

    Raises:
      ValueError: a page asks for what no record makes; it is named.
    """
    found: dict[Path, Callable[[], object]] = {}
    for path in sorted(path for pattern in PAGES for path in root.glob(pattern)):
        text = path.read_text(encoding="utf-8")
        try:
            made = generate(text, records)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        if made != text:
            found[path] = partial(path.write_text, made, encoding="utf-8")
    drawn = {name: record for name, record in records.items() if _kind(record) in FIGURES}
    for name, record in drawn.items():
        own_figures = FIGURES[_kind(record)]
        for file, draw in own_figures.drawings(record, name).items():
            path = root / "benchmarks" / "results" / "figures" / file
            if figures.drawn_from(path) != own_figures.digest(record):
                found[path] = partial(draw, path)
    return found


def main(arguments: Arguments) -> None:
    """Compares, writes if asked to, and exits with 1 if it finds what is out of date."""
    try:
        records = read_records(arguments.results)
        found = stale(arguments.root, records)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error
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
