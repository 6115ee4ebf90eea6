"""Options are read from the fields of a dataclass."""

import dataclasses
from pathlib import Path

import pytest

from agents.command_line import option, parse, parse_all
from agents.config import Config


@dataclasses.dataclass(frozen=True)
class Options:
    """Does something.

    Attributes:
      files: some files, by default those of `here`. They may be missing.
      out: a folder.
      extra: another folder.
      more: names.
      none: no names, or some.
    """

    files: tuple[Path, ...]
    out: Path = Path("runs")
    extra: Path | None = None
    more: tuple[str, ...] = ("b",)
    none: tuple[str, ...] | None = option(None, may_be_empty=True)


@pytest.mark.parametrize(
    ("word", "meant"), [("--otu=x", " (did you mean '--out'?)"), ("--xyz", "")]
)
def test_an_unknown_option_is_refused_and_the_nearest_offered(word, meant, capsys):
    with pytest.raises(SystemExit):
        parse(Options, ["a", word], "x")
    assert capsys.readouterr().err.endswith(f"error: unknown arguments: {word}{meant}\n")


def test_an_option_needs_a_value_unless_it_may_be_empty(capsys):
    """A shell's variable may be empty."""
    for arguments in (["a", "--more"], []):
        with pytest.raises(SystemExit):
            parse(Options, arguments, "x")
    assert "the following arguments are required: FILES" in capsys.readouterr().err
    assert parse(Options, ["a", "--none"], "x").none == ()


def test_help_shows_the_first_sentence_about_an_option(capsys):
    with pytest.raises(SystemExit):
        parse(Options, ["--help"], "x")
    shown = " ".join(capsys.readouterr().out.split())
    assert "some files, by default those of `here`" in shown
    assert "missing" not in shown


def test_a_number_that_may_be_missing_can_be_reset(capsys):
    """As fine-tuning begins with the limits of a stored run."""
    preset = Config.preset("best")
    found = parse_all([preset], ["--max-transitions", "None", "--max-steps", "7"], "x")[0]
    assert (found.max_transitions, found.max_steps) == (None, 7)
    with pytest.raises(SystemExit):
        parse_all([preset], ["--max-steps", "none"], "x")
    assert "argument --max-steps: invalid int value: 'none'" in capsys.readouterr().err


def test_a_leading_tilde_in_a_path_is_the_home_folder(monkeypatch):
    """Also where no shell expands it, as in --out=~/x."""
    monkeypatch.setenv("HOME", "/home/somebody")
    found = parse(Options, ["~/a", "b", "--out=~/c", "--extra", "~"], "x")
    home = Path("/home/somebody")
    assert found == Options((home / "a", Path("b")), home / "c", home)
    with pytest.raises(SystemExit):
        parse(Options, ["x", "--out=~nobody-has-this-name/c"], "x")
