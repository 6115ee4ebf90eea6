"""Traced programs, kept from one process to the next."""

import os
import sys
import types
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.config import Config
from agents.runs import traces
from agents.runs.traces import Traces

CODE = bytes(32)
INPUTS = ({"x": np.ones(3, np.float32)}, None)


def make_sums() -> Callable[..., Any]:
    return lambda inputs, _: {"sum": jnp.sum(inputs["x"]), "nothing": None}


def unmade(*_: Any) -> Any:
    raise AssertionError("traced anew")


def test_a_trace_is_taken_up(tmp_path):
    for make in (make_sums, unmade):
        kept = Traces(tmp_path, CODE).kept(make, INPUTS, "about", 1)
        chex.assert_trees_all_equal(jax.jit(kept)(*INPUTS), {"sum": np.float32(3), "nothing": None})


@pytest.mark.parametrize(
    ("code", "inputs", "about"),
    [
        (bytes([*CODE[1:], 1]), INPUTS, ("about", 1)),
        (CODE, ({"x": np.ones(4, np.float32)}, None), ("about", 1)),
        (CODE, ({"x": np.ones(3, np.int32)}, None), ("about", 1)),
        (CODE, ({"y": np.ones(3, np.float32)}, None), ("about", 1)),
        (CODE, INPUTS, ("about", 2)),
    ],
    ids=["code", "shape", "dtype", "structure", "about"],
)
def test_what_differs_is_traced_anew(tmp_path, code, inputs, about):
    Traces(tmp_path, CODE).kept(make_sums, INPUTS, "about", 1)
    with pytest.raises(AssertionError, match="traced anew"):
        Traces(tmp_path, code).kept(unmade, inputs, *about)


def test_newer_code_replaces_a_trace(tmp_path):
    for code in (CODE, bytes([*CODE[1:], 1])):
        Traces(tmp_path, code).kept(make_sums, INPUTS)
    assert len(list(tmp_path.iterdir())) == 1


def test_a_damaged_file_is_traced_anew(tmp_path):
    kept = Traces(tmp_path, CODE)
    kept.kept(make_sums, INPUTS)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    for damaged in (b"", whole[:40], whole[:-1], whole[:-1] + bytes([whole[-1] ^ 1])):
        path.write_bytes(damaged)
        kept.kept(make_sums, INPUTS)
        kept.kept(unmade, INPUTS)


def test_a_folder_that_cannot_be_written_costs_time_alone(tmp_path):
    (tmp_path / "file").touch()
    kept = Traces(tmp_path / "file" / "traces", CODE).kept(make_sums, INPUTS)
    assert jax.jit(kept)(*INPUTS)["sum"] == 3


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process is one of `python -m agents.train`, and its sources are old."""
    spec = types.SimpleNamespace(name="agents.train")
    monkeypatch.setitem(sys.modules, "__main__", types.SimpleNamespace(__spec__=spec))
    monkeypatch.setattr(traces, "UNCHANGED_SINCE", float("inf"))


def test_commands_of_this_package_keep_traces(command):
    kept = Traces.of(Config())
    assert kept is not None
    assert str(kept.folder).startswith(os.environ["JAX_COMPILATION_CACHE_DIR"])


def test_what_may_trace_something_else_keeps_nothing(command, monkeypatch):
    assert Traces.of(Config.from_dict({**Config().to_dict(), "imports": ["os"]})) is None
    with monkeypatch.context() as patch:
        patch.setattr(traces, "UNCHANGED_SINCE", 0)  # edited since it was imported
        assert Traces.of(Config()) is None
    jax.config.update("jax_enable_compilation_cache", False)
    assert Traces.of(Config()) is None
    jax.config.update("jax_enable_compilation_cache", True)
    assert Traces.of(Config()) is not None
    for spec in (None, types.SimpleNamespace(name="pytest.__main__")):
        monkeypatch.setattr(sys.modules["__main__"], "__spec__", spec)
        assert Traces.of(Config()) is None


def test_code_is_every_source_and_setting(tmp_path, monkeypatch):
    for name in ("agents", "trap_tube_jax"):
        (tmp_path / name / "inner").mkdir(parents=True)
        (tmp_path / name / "inner" / "a.py").write_text("x = 1")
        package = types.SimpleNamespace(__path__=[str(tmp_path / name)])
        monkeypatch.setattr(traces, name, package)
    monkeypatch.setattr(traces, "UNCHANGED_SINCE", float("inf"))
    found = {traces.code_digest()}
    assert traces.code_digest() in found
    for name in ("agents", "trap_tube_jax"):
        (tmp_path / name / "inner" / "a.py").write_text("x = 2")
        found.add(traces.code_digest())
    (tmp_path / "agents" / "inner" / "a.py").rename(tmp_path / "agents" / "inner" / "b.py")
    found.add(traces.code_digest())
    before = jax.config.values["jax_default_matmul_precision"]
    jax.config.update("jax_default_matmul_precision", "float32")
    found.add(traces.code_digest())
    jax.config.update("jax_default_matmul_precision", before)
    assert len(found) == 5
