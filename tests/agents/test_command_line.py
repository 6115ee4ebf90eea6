"""Options are read from the fields of a dataclass."""

import dataclasses
from pathlib import Path

import pytest

from agents.command_line import parse


@dataclasses.dataclass(frozen=True)
class Options:
    """Does something.

    Attributes:
      files: some files.
      out: a folder.
      extra: another folder.
    """

    files: tuple[Path, ...]
    out: Path = Path("runs")
    extra: Path | None = None


def test_a_leading_tilde_in_a_path_is_the_home_folder(monkeypatch):
    """Also where no shell expands it, as in --out=~/x."""
    monkeypatch.setenv("HOME", "/home/somebody")
    found = parse(Options, ["~/a", "b", "--out=~/c", "--extra", "~"], "x")
    home = Path("/home/somebody")
    assert found == Options((home / "a", Path("b")), home / "c", home)
    with pytest.raises(SystemExit):
        parse(Options, ["x", "--out=~nobody-has-this-name/c"], "x")
