"""The terminal of a command."""

import sys

import pytest

from agents.runs.console import CommandConsole


@pytest.mark.parametrize(
    ("is_terminal", "environment", "changes"),
    [
        (True, {"TERM": "xterm"}, True),
        (True, {"TERM": "dumb"}, False),
        (True, {"TERM": "dumb", "FORCE_COLOR": "1"}, False),
        (False, {"TERM": "xterm"}, False),
        (False, {"TERM": "xterm", "FORCE_COLOR": "1"}, False),
        (False, {"TERM": "xterm", "TTY_COMPATIBLE": "1"}, False),
    ],
)
def test_lines_change_only_on_a_terminal_that_can_do_so(
    is_terminal, environment, changes, monkeypatch
):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: is_terminal)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    console = CommandConsole()
    assert console.is_terminal == changes
    with console.capture() as printed:
        console.print("[bold red]x[/]")
    assert changes or printed.get() == "x\n", "readable in a log"
