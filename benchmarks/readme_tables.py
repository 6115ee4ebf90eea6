"""The README's tables of results, from the recorded files: python -m benchmarks.readme_tables.

A block of the README between `<!-- table: NAME -->` and `<!-- end -->` holds the tables of
`benchmarks/results/NAME.json`, which `python -m agents.experiments --record` writes.
"""

import dataclasses
import json
import re
import sys
from pathlib import Path
from typing import Annotated

import tyro

from agents.experiments import tables

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"(?P<start><!-- table: (?P<name>\S+) -->\n).*?(?P<end><!-- end -->)", re.DOTALL)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Says which blocks of the README are not what the recorded results make of them.

    Attributes:
      write: bring these blocks up to date.
      readme: the file with the blocks.
      results: the folder of recorded results.
    """

    write: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    readme: Path = ROOT / "README.md"
    results: Path = ROOT / "benchmarks" / "results"


def generate(text: str, results: Path) -> str:
    """The text with every block made anew.

    Raises:
      ValueError: a block names no recorded result; the message lists them.
    """

    def fill(match: re.Match[str]) -> str:
        path = results / f"{match['name']}.json"
        if not path.is_file():
            known = ", ".join(sorted(entry.stem for entry in results.glob("*.json"))) or "none"
            raise ValueError(f"no recorded results {match['name']!r}; allowed: {known}")
        made = tables.markdown(json.loads(path.read_text()))
        return f"{match['start']}\n{made}\n\n{match['end']}"

    return BLOCK.sub(fill, text)


def main(arguments: Arguments) -> None:
    """Compares, writes if asked to, and exits with 1 where blocks were or are out of date."""
    text = arguments.readme.read_text()
    try:
        made = generate(text, arguments.results)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    names = [match["name"] for match in BLOCK.finditer(text)]
    if made == text:
        print(f"up to date: {', '.join(names)}")
        return
    if not arguments.write:
        print(f"{arguments.readme} is out of date; give --write to bring it up to date")
        raise SystemExit(1)
    arguments.readme.write_text(made)
    print(f"written: {', '.join(names)}")


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
