"""Parts of a profile hold the tasks that their names and levels promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.profiles.tasks import PARTS, Sampling, layout_kinds
from trap_tube_jax.controls import trap_exchanged
from trap_tube_jax.state import take

LAYOUT = ("board", "agent", "tool", "tool_extent", "food")
STRENGTH_PARTS = ("structural", "perceptual", "both")
SAMPLING = Sampling((0.0, 1.0), 3, 3)
observe = jax.vmap(tt.observe)


def level(part, name):
    tasks, levels = PARTS[part](SAMPLING)
    return take(tasks, np.array(levels) == name)


def same(one, other, *fields):
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in fields)


def test_transfers_change_layout_or_colours_and_draw_alike_in_all_parts():
    base = jax.tree.map(lambda x: np.stack([x] * 3), tt.base_state())
    for part in STRENGTH_PARTS:
        assert same(level(part, "0"), take(base, slice(1)), *LAYOUT, "palette")
    structural, perceptual, both = (level(part, "1") for part in STRENGTH_PARTS)
    assert same(structural, base, *LAYOUT)
    assert same(perceptual, base, "palette")
    assert same(perceptual, both, *LAYOUT)
    assert same(level("symbolic", "tool"), both, *LAYOUT, "palette")
    assert not same(level("symbolic", "trap"), both, *LAYOUT)
    for part in ("kind", "plan-length", "first-push-p"):
        assert same(PARTS[part](SAMPLING).tasks, perceptual, *LAYOUT, "palette")
    assert same(PARTS["first-push-pst"](SAMPLING).tasks, both, *LAYOUT, "palette")
    for part, tasks in {"first-grasp-psy": perceptual, "first-grasp-pstsy": both}.items():
        swapped = PARTS[part](SAMPLING).tasks
        assert not same(swapped, tasks, *LAYOUT)
        assert np.array_equal(observe(swapped), observe(tasks))


def test_controls_have_the_layouts_of_the_registered_sets_in_base_colours():
    tasks, levels = PARTS["control"](SAMPLING)
    names = set(np.asarray(levels).tolist())
    assert len(names) == 14
    sets = {"base", *(entry.short for entry in tt.CONTROL_TASK_SETS)}
    assert {name.split(",")[0] for name in names} == sets
    assert all(np.array_equal(palette, tt.base_palette()) for palette in tasks.palette)


@pytest.mark.parametrize(
    ("state", "agent", "extent", "kind"),
    [
        (tt.base_state(), (9, 1), (4, 1), "away, across"),  # the food leaves to the right
        (tt.base_state(), (11, 5), (4, 1), "sideways, across"),
        (tt.base_state(), (5, 1), (1, 4), "away, along"),
        (tt.base_state(), (7, 11), (1, 4), "towards, along"),
        (trap_exchanged()[0], (7, 11), (1, 4), "away, along"),
    ],
)
def test_layouts_are_grouped_by_push_and_tool_direction(state, agent, extent, kind):
    state = state.replace(agent=jnp.array(agent), tool_extent=jnp.array(extent))
    assert layout_kinds(jax.tree.map(lambda x: x[None], state)) == [kind]
