"""The programs in `agents/examples`, at small sizes."""

import runpy
import sys

import pytest


def test_help_explains_a_program_instead_of_running_it(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["plain_ppo", "--help"])
    monkeypatch.delitem(sys.modules, "agents.examples.plain_ppo", raising=False)
    with pytest.raises(SystemExit) as stopped:
        runpy.run_module("agents.examples.plain_ppo", run_name="__main__")
    assert stopped.value.code == 0
    assert "usage:" in capsys.readouterr().out
