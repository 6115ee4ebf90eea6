"""Importing `trap_tube_jax`: exports, documentation, and the registration with Gymnasium."""

import importlib
import re
import sys
import textwrap
from importlib import resources

import pytest

import trap_tube_jax as tt


def test_the_package_states_its_public_names_and_opens_with_a_program(capsys):
    assert dir(tt) == sorted(tt.__all__)
    _, program, steps, rest = (tt.__doc__ or "").split("\n\n", 3)
    for name in tt.__all__:
        assert re.search(rf"\b{name}\b", rest), name
    exec(textwrap.dedent(f"{program}\n\n{steps}"), {})
    assert capsys.readouterr().out.endswith("1.0 True\n")
    assert resources.files(tt).joinpath("py.typed").is_file()


def test_only_a_missing_gymnasium_goes_unsaid(monkeypatch):
    monkeypatch.setitem(sys.modules, "trap_tube_jax.adapters.to_gymnasium", None)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "gymnasium", None)
        tt._register_with_gymnasium()
    monkeypatch.setitem(sys.modules, "gymnasium", tt)  # some version
    with pytest.warns(UserWarning, match=r"Gymnasium: .*to_gymnasium"):
        tt._register_with_gymnasium()

    def fail(name):
        raise AttributeError(name)

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.warns(UserWarning, match=r"Gymnasium: .*to_gymnasium"):
        tt._register_with_gymnasium()
