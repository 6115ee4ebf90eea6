"""First pushes and first grasps on hand-made boards."""

import jax
import numpy as np
import pytest

import trap_tube_jax as tt
from trap_tube_jax.scoring.knowledge import choice_of_exit, first_grasp, first_push

UP, DOWN, LEFT, RIGHT = range(4)
# The tool is above the food's column. The agent is above the tool and carries it by grasping down.
DOWNWARD = (DOWN, DOWN)
LEFTWARD = (DOWN, LEFT)
RIGHTWARD = (DOWN, RIGHT)
NONE = (0, 0)


def task(line, food=6):
    """Builds a tube whose inside and ends are `line`, with a tool above it."""
    rows = ["." * 12] * 5 + ["..11111111..", line, "..22222222..", *["." * 12] * 4]
    return tt.State.from_ascii(
        rows, agent=(1, food), tool=(2, food), tool_extent=(3, 1), food=(6, food)
    )


LEFT_OF_FOOD = [LEFTWARD, DOWNWARD, DOWNWARD]
RIGHT_OF_FOOD = [RIGHTWARD, DOWNWARD, DOWNWARD]


@pytest.mark.parametrize(
    ("line", "actions", "push", "choice"),
    [
        ("..x......e..", [*LEFT_OF_FOOD, RIGHTWARD], (0, 1), 1),
        ("..x......e..", [*RIGHT_OF_FOOD, LEFTWARD], (0, -1), -1),
        ("..e......x..", [*RIGHT_OF_FOOD, LEFTWARD], (0, -1), 1),
        # Later pushes do not count.
        ("..x......e..", [*RIGHT_OF_FOOD, LEFTWARD, *[RIGHTWARD] * 2], (0, -1), -1),
        ("..x......e..", LEFT_OF_FOOD, NONE, 0),  # the tool is beside the food
        ("..x......e..", [DOWNWARD], NONE, 0),  # the wall is below the food
        ("..x......e..", np.zeros((0, 2), np.int32), NONE, 0),  # a task without a plan
        # The trap is next to the food, so that the tool can push it one way only.
        (".....x...e..", [*LEFT_OF_FOOD, RIGHTWARD], (0, 1), 0),
        (".....e...x..", [*RIGHT_OF_FOOD, LEFTWARD], (0, -1), 1),  # the exit lets it pass
        ("..e......e..", [*LEFT_OF_FOOD, RIGHTWARD], (0, 1), 0),  # both ways are right
        ("..x......x..", [*LEFT_OF_FOOD, RIGHTWARD], (0, 1), 0),  # neither is
        ("..x.....xe..", [*LEFT_OF_FOOD, RIGHTWARD], (0, 1), 0),  # a trap is before the exit
        ("..........e.", [*LEFT_OF_FOOD, RIGHTWARD], (0, 1), 1),  # the other way ends nowhere
    ],
)
def test_first_push_and_whether_it_chose_the_exit(line, actions, push, choice):
    found = first_push(task(line), np.array(actions))
    assert tuple(found.tolist()) == push
    assert choice_of_exit(task(line), found) == choice


def test_a_push_towards_a_side_of_the_tube_is_no_choice():
    tube = ["....1111....", "....x..e....", "....xF.e....", "....2222...."]
    rows = [*["." * 12] * 4, *tube, *["." * 12] * 4]
    state = tt.State.from_ascii(rows, agent=(10, 5), tool=(7, 5), tool_extent=(3, 1))
    push = first_push(state, np.array([(UP, UP)]))
    assert push.tolist() == [-1, 0]
    assert choice_of_exit(state, push) == 0


def test_an_episode_of_the_base_task_may_be_batched():
    """The trap is next to the food, so the shortest plan makes no choice."""
    state = tt.base_state()
    plan = tt.solve(state)
    batch = jax.tree.map(lambda x: x[None], state)
    push = jax.vmap(first_push)(batch, plan.actions[None])
    assert push.tolist() == [[0, 1]]
    assert jax.vmap(choice_of_exit)(batch, push).tolist() == [0]


TOOL_ABOVE = {"agent": (4, 5), "tool": (3, 3)}  # the tool is 1 x 4, the agent below it


@pytest.mark.parametrize(
    ("where", "actions", "grasp"),
    [
        (TOOL_ABOVE, [(UP, LEFT)], 1),
        (TOOL_ABOVE, [(DOWN, LEFT)], -1),  # of the tube
        (TOOL_ABOVE, [(DOWN, LEFT), (UP, LEFT)], -1),  # later grasps do not count
        (TOOL_ABOVE, [(LEFT, LEFT), (UP, LEFT)], 1),  # grasps at ground do not count
        (TOOL_ABOVE, [(DOWN, DOWN), (UP, RIGHT)], -1),  # even if the tube stops the agent
        (TOOL_ABOVE, [(UP, UP)], 1),  # a push
        (TOOL_ABOVE, [], 0),
        ({"agent": (4, 0), "tool": (0, 8)}, [(LEFT, UP)], 0),  # grasps beyond the board
        ({"agent": (6, 1), "tool": (0, 8)}, [(RIGHT, UP)], -1),  # the trap
        ({"agent": (6, 1), "tool": (6, 2)}, [(RIGHT, UP)], 1),  # the tool hides the trap
        ({"agent": (6, 1), "tool": (6, 0)}, [(RIGHT, UP)], 0),  # the agent is on the tool
        ({"agent": (6, 10), "tool": (0, 8)}, [(LEFT, DOWN)], -1),  # the exit
    ],
)
def test_whether_the_first_grasp_held_the_tool(where, actions, grasp):
    state = task("..x......e..").replace(
        **{name: np.array(cell, np.int32) for name, cell in where.items()},
        tool_extent=np.array((1, 4), np.int32),
    )
    actions = np.array(actions, np.int32).reshape(-1, 2)
    assert first_grasp(state, actions) == grasp
    assert first_grasp(state.replace(terminated=np.array(True)), actions) == 0


def test_a_fifth_of_the_first_grasps_of_random_actions_hold_the_tool():
    """As protocol.md says, 20 to 21 %; the standard error is 1 %."""
    tasks = tt.evaluation_tasks("psy", 2000)
    actions = jax.random.randint(jax.random.key(0), (2000, 50, 2), 0, 4)
    grasps = np.asarray(jax.jit(jax.vmap(first_grasp))(tasks, actions))
    assert (grasps == 1).sum() / (grasps != 0).sum() == pytest.approx(0.205, abs=0.03)
