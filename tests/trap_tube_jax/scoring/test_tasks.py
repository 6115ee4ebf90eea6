"""The fixed tasks: draws of their environments, by keys that nothing else uses."""

import zlib
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from helpers.refusal import assert_refused
from helpers.trees import assert_same
from trap_tube_jax.registry import PAPER_TASK_SETS
from trap_tube_jax.scoring.tasks import (
    ALL_SETS,
    PROTOCOL,
    Purpose,
    evaluation_keys,
    evaluation_tasks,
    label,
    layout_numbers,
)


def test_tasks_are_drawn_by_reset_under_the_evaluation_keys():
    keys = evaluation_keys("PerceptualSymbolicTrapTube-v0", 3)
    drawn, _ = jax.jit(jax.vmap(tt.make("psy").reset))(keys)
    assert_same(evaluation_tasks("psy", 3), drawn)
    assert_same(evaluation_tasks("psy", 2), jax.tree.map(lambda x: x[:2], drawn))
    assert_same(evaluation_tasks("PerceptualSymbolicTrapTube-v0", 3), drawn)


def test_a_rare_invalid_task_is_refused(fresh_task_sets):
    """One that the trials of `Environment` do not meet."""

    def rarely_solved(key, state):
        chosen = jax.random.uniform(key) < 0.01
        return state.replace(agent=jnp.where(chosen, state.food, state.agent))

    tt.register("Rare-v0", (rarely_solved,), short="rare")
    assert_refused(["Rare-v0", "agent and food share"], evaluation_tasks, "rare", 1000)


def test_keys_differ_within_and_between_sets_and_purposes():
    keys = [
        jax.random.key_data(evaluation_keys(entry.id, 64, purpose))
        for entry in PAPER_TASK_SETS
        for purpose in get_args(Purpose)
    ]
    assert len(np.unique(np.concatenate(keys), axis=0)) == 64 * len(keys)


def test_the_keys_of_a_version_of_the_protocol_never_change():
    expected = {"test": 3337741939, "validation": 3680116239, "confirmation": 4181204745}
    for purpose in get_args(Purpose):
        keys = [evaluation_keys(entry.id, 4, purpose) for entry in PAPER_TASK_SETS]
        data = b"".join(np.asarray(jax.random.key_data(key)).tobytes() for key in keys)
        assert (PROTOCOL, zlib.crc32(data)) == (1, expected[purpose]), purpose


@pytest.mark.parametrize("name", ALL_SETS)
def test_only_sets_without_p_have_few_layouts(name):
    layout = layout_numbers(name, evaluation_tasks(name, 64))
    number = {"base": 1, "st": 1, "sy": 5, "stsy": 5}.get(name)
    assert (None if layout is None else len(set(layout.tolist()))) == number


@pytest.mark.parametrize(
    ("name", "shown"),
    [("psy", "{P, Sy}"), ("p+pstsy", "{P} + {P, St, Sy}"), ("mine+p", "mine + {P}")],
)
def test_labels_are_in_the_papers_notation_as_far_as_sets_are_registered(name, shown):
    assert label(name) == shown
