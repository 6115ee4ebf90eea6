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


@pytest.mark.parametrize(
    ("word", "meant"), [("--otu=x", " (did you mean '--out'?)"), ("--xyz", "")]
)
def test_an_unknown_option_is_refused_and_the_nearest_offered(word, meant, capsys):
    with pytest.raises(SystemExit):
        parse(Options, ["a", word], "x")
    assert capsys.readouterr().err.endswith(f"error: unknown arguments: {word}{meant}\n")


def test_a_leading_tilde_in_a_path_is_the_home_folder(monkeypatch):
    """Also where no shell expands it, as in --out=~/x."""
    monkeypatch.setenv("HOME", "/home/somebody")
    found = parse(Options, ["~/a", "b", "--out=~/c", "--extra", "~"], "x")
    home = Path("/home/somebody")
    assert found == Options((home / "a", Path("b")), home / "c", home)
    with pytest.raises(SystemExit):
        parse(Options, ["x", "--out=~nobody-has-this-name/c"], "x")
