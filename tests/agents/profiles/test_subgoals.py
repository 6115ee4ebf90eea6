"""Subgoals along hand-made episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.profiles.subgoals import SUBGOALS, last_subgoals

UP, DOWN, LEFT, RIGHT = range(4)
# The shortest plan of the base task, in pairs of grasp and move.
PLAN = [(UP, UP), *[(UP, RIGHT)] * 6, (DOWN, RIGHT), *[(UP, UP)] * 3]
AWAY = [(DOWN, DOWN)]


def base_with(**cells):
    return tt.base_state().replace(**{name: jnp.array(cell) for name, cell in cells.items()})


@pytest.mark.parametrize(
    ("state", "actions", "expected"),
    [
        (tt.base_state(), AWAY, "none"),
        (tt.base_state(), PLAN[:1], "none"),
        (tt.base_state(), PLAN[:2], "tool moved"),
        (tt.base_state(), PLAN[:5], "food moved"),
        (tt.base_state(), PLAN[:6], "food out"),
        (tt.base_state(), PLAN, "food out"),
        # The agent pushes the tool against the border of the board.
        (base_with(agent=(4, 1), tool=(0, 1)), [(UP, UP)], "tool touched"),
        # The food is in the exit: free, then behind the tool, which the agent cannot walk through.
        (base_with(food=(5, 7)), AWAY, "food out"),
        (base_with(food=(5, 7), tool=(4, 8)), AWAY, "none"),
    ],
)
def test_last_subgoal(state, actions, expected):
    tasks = jax.tree.map(lambda x: x[None], state)
    assert SUBGOALS[last_subgoals(tasks, np.array([actions], np.int32)).item()] == expected


def test_an_episode_counts_the_subgoal_that_it_has_left_again():
    tasks = jax.tree.map(lambda x: jnp.stack([x, x]), tt.base_state())
    back = [*PLAN[:2], (UP, LEFT)]  # the tool is where it was
    found = last_subgoals(tasks, np.array([back, AWAY * 3], np.int32))
    assert [SUBGOALS[index] for index in found] == ["tool moved", "none"]
