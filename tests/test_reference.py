"""The API reference: public names have a docstring whose example prints what it states."""

import ast
import doctest
import inspect
import itertools
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import agents
import trap_tube_jax as tt
from helpers.jax_settings import HAS_DEFAULT_DRAWS

NAMES = {"jax": jax, "jnp": jnp, "np": np, "tt": tt, "agents": agents}
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
SLOW = {"Learner", "train_run", "results"}  # compile an iteration of training
PUBLIC = [
    pytest.param(module, name, id=name, marks=[pytest.mark.slow] if name in SLOW else [])
    for module in (tt, agents)
    for name in module.__all__
]


def of_constants(module: ModuleType) -> dict[str, str]:
    """Returns the docstrings that follow assignments in a module."""
    body = ast.parse(inspect.getsource(module)).body
    return {
        ast.unparse(before.targets[0]): ast.literal_eval(after.value)
        for before, after in itertools.pairwise(body)
        if isinstance(before, ast.Assign) and isinstance(after, ast.Expr)
    }


CONSTANTS = of_constants(tt)


def examples(module: ModuleType, name: str) -> list[doctest.DocTest]:
    """Returns the examples of a public name and of its methods."""
    if name in CONSTANTS:
        return [doctest.DocTestParser().get_doctest(CONSTANTS[name], NAMES, name, None, None)]
    public: Any = getattr(module, name)
    found = doctest.DocTestFinder().find(public, name, module=False, extraglobs=NAMES)
    return [test for test in found if test.examples]


@pytest.mark.usefixtures("fresh_names")
@pytest.mark.parametrize(("module", "name"), PUBLIC)
def test_the_example_of_a_public_name_prints_the_stated_output(module, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = examples(module, name)
    assert found
    printed = []
    for test in found:
        result = doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=printed.append)
        if HAS_DEFAULT_DRAWS:
            assert not result.failed, "".join(printed)
