"""Copies of public objects: equal to the original, and of the same use."""

import itertools
import pickle
from typing import Any

import jax
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.easy_task import EASY
from helpers.trees import COPIES
from trap_tube_jax.adapters.next_step import NextStepVectorEnvironment
from trap_tube_jax.controls import CONTROLS, LayoutDraw

OPTIMISED = False  # few steps
KEY = jax.random.key(0)
GRADED = (tt.graded_perceptual(0.5), tt.graded_structural(0.25))


@pytest.fixture(scope="module")
def environments() -> dict[str, Any]:
    return {
        "base": tt.make("base"),
        "shorter": tt.make("base", max_steps=5),
        "own base": tt.Environment(base=EASY),
        "more features": tt.make("base", num_features=4),
        "paper": tt.make("pstsy"),
        "graded": tt.Environment(GRADED),
        "control": tt.make("two-traps"),
        "auto-reset": tt.AutoReset(tt.make("pstsy")),
        "vector": tt.VectorEnvironment(tt.make("pstsy")),
        "next step": NextStepVectorEnvironment(tt.make("pstsy")),
    }


@pytest.fixture(scope="module")
def public(environments: dict[str, Any]) -> list[Any]:
    """Returns public objects, of which no two are equal."""
    transfers: list[tt.Transfer] = [
        *(tt.perceptual, tt.structural, tt.symbolic, *GRADED, tt.graded_perceptual(0.75)),
        *(tt.compose(), tt.compose(tt.perceptual, *GRADED), tt.compose(tt.structural)),
        *map(LayoutDraw, CONTROLS),
    ]
    states = [
        *(
            jax.jit(environments[name].reset)(jax.random.clone(KEY))
            for name in ("own base", "more features", "auto-reset")
        ),
        jax.jit(environments["vector"].reset)(jax.random.split(jax.random.clone(KEY), 2)),
    ]
    return [
        *(*environments.values(), *transfers, *tt.PAPER_TASK_SETS, *tt.CONTROL_TASK_SETS),
        *(*itertools.chain(*states), tt.base_state(), environments["base"].observation_spec),
        *(tt.solve(EASY), tt.solve(tt.base_state())),
    ]


@pytest.mark.parametrize("duplicate", COPIES.values(), ids=COPIES)
def test_a_copy_equals_its_original_and_nothing_else(public, duplicate):
    copies = [duplicate(value) for value in public]
    for (i, value), (j, other) in itertools.product(enumerate(public), enumerate(copies)):
        assert (value == other) == (i == j), (value, other)
    assert [hash(value) for value in public] == [hash(value) for value in copies]


@pytest.mark.parametrize("name", ["graded", "control", "auto-reset"])
def test_an_unpickled_environment_plays_the_same(environments, name):
    def play(env: Any) -> Any:
        state, first = jax.jit(env.reset)(jax.random.clone(KEY))
        return [first, *jax.jit(env.step)(state, np.zeros(2, np.int32))]

    env = environments[name]
    assert play(pickle.loads(pickle.dumps(env))) == play(env)


def test_a_subclass_with_other_attributes_is_another():
    class Named(tt.Environment):
        def __init__(self, name: str):
            super().__init__()
            self.name = name

    assert Named("one") == Named("one") != Named("two")
    assert Named("one") != tt.Environment()


def test_a_state_equals_neither_another_nor_an_array():
    state = tt.base_state()
    assert state == jax.device_get(state), "NumPy arrays of the same dtype and content"
    assert state != state.replace(time=np.int64(0)) != 0
    assert len({state, tt.base_state(), state.replace(time=np.int32(1))}) == 2
