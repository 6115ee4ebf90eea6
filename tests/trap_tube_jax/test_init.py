"""The first things a user meets: `import trap_tube_jax`, `dir` and `help`."""

import pydoc
import re
import sys
import textwrap

import pytest

import trap_tube_jax as tt


def test_dir_holds_the_public_names_alone():
    assert dir(tt) == sorted(tt.__all__)
    assert {"State", "episode_frames", "evaluation_tasks", "make"} <= set(tt.__all__)
    assert not {"state", "registry", "importlib"} & set(tt.__all__)
    names: dict[str, object] = {}
    exec("from trap_tube_jax import *", names)
    assert set(names) - {"__builtins__"} == set(tt.__all__)


def test_help_fits_two_screens_and_opens_with_a_program(capsys):
    text = pydoc.plain(pydoc.render_doc(tt))
    assert len(text.splitlines()) <= 100
    for name in tt.__all__:
        assert re.search(rf"\b{name}\b", text), name
    _, program, *_ = (tt.__doc__ or "").split("\n\n", 2)
    assert program.startswith("    import jax")
    exec(textwrap.dedent("\n\n".join((tt.__doc__ or "").split("\n\n")[1:3])), {})
    assert capsys.readouterr().out.endswith("1.0 True\n")


def test_only_a_missing_gymnasium_goes_unsaid(monkeypatch):
    monkeypatch.setitem(sys.modules, "trap_tube_jax.adapters.to_gymnasium", None)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "gymnasium", None)
        tt._register_with_gymnasium()
    monkeypatch.setitem(sys.modules, "gymnasium", tt)  # some version
    with pytest.warns(UserWarning, match=r"Gymnasium: .*to_gymnasium"):
        tt._register_with_gymnasium()
