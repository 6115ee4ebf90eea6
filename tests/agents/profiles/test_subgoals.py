"""Subgoals along hand-made episodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.profiles.subgoals import SUBGOALS, last_subgoals, replay

UP, DOWN, LEFT, RIGHT = range(4)
# The shortest plan of the base task, in pairs of grasp and move.
PLAN = [(UP, UP), *[(UP, RIGHT)] * 6, (DOWN, RIGHT), *[(UP, UP)] * 3]
AWAY = [(DOWN, DOWN)]


@pytest.mark.parametrize(
    ("cells", "actions", "expected"),
    [
        ({}, AWAY, "none"),
        ({}, PLAN[:1], "none"),
        ({}, PLAN[:2], "tool moved"),
        ({}, [*PLAN[:2], (UP, LEFT)], "tool moved"),  # and is back in its first cell
        ({}, PLAN[:5], "food moved"),
        ({}, PLAN[:6], "food out"),
        ({}, PLAN, "food out"),
        # The agent pushes the tool against the border of the board.
        ({"agent": (4, 1), "tool": (0, 1)}, [(UP, UP)], "tool touched"),
        # The food is in the exit: free, then behind the tool, which the agent cannot walk through.
        ({"food": (5, 7)}, AWAY, "food out"),
        ({"food": (5, 7), "tool": (4, 8)}, AWAY, "none"),
    ],
)
def test_last_subgoal_of_an_episode_in_a_batch(cells, actions, expected):
    base = tt.base_state()
    state = base.replace(**{name: jnp.array(cell) for name, cell in cells.items()})
    tasks = jax.tree.map(lambda *x: np.stack(x), base, state)
    batch = np.array([AWAY * len(actions), actions], np.int32)
    found = last_subgoals(tasks, batch, replay(tasks, batch))
    assert [SUBGOALS[index] for index in found] == ["none", expected]
