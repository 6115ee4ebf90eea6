"""The rules of one step: picture by picture, and exhaustively."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helpers.spec_reference as spec
import trap_tube_jax as tt
from trap_tube_jax.transfers import SYMBOLIC_OBJECTS, swap_with_tool

ENV = tt.make("TrapTube-v0")
UP, DOWN, LEFT, RIGHT = range(4)
CELLS = np.stack(np.divmod(np.arange(144), 12), axis=-1).astype(np.int32)
ALL_ACTIONS = [(grasp, move) for grasp in range(4) for move in range(4)]


def _moved(before: jax.Array, after: jax.Array, by: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns whether the cell moved by `by`, and whether it moved so or not at all."""
    stayed = (before[0] == after[0]) & (before[1] == after[1])
    moved = (before[0] + by[0] == after[0]) & (before[1] + by[1] == after[1])
    return moved, stayed | moved


def _outcome_code(start: tt.State, agent, tool, food, action) -> jax.Array:
    """One step's whole outcome in one byte: what moved and success, or 255 for the impossible."""
    state = start.replace(agent=agent, tool=tool, food=food)
    after, timestep = ENV.step(state, action)
    by = jnp.asarray(spec.DIRECTIONS, jnp.int32)[action[1]]
    code = timestep.terminated.astype(jnp.uint8)
    possible = ~timestep.truncated
    for name in ("agent", "tool", "food"):
        moved, explained = _moved(getattr(state, name), getattr(after, name), by)
        code = 2 * code + moved
        possible = possible & explained
    possible &= (timestep.reward == timestep.terminated) & (after.time == 1)
    for name in ("board", "palette", "tool_extent"):
        possible &= jnp.all(getattr(after, name) == getattr(start, name))
    return jnp.where(possible, code, jnp.uint8(255))


def _over_all(function, axis: int):
    return jax.vmap(function, tuple(0 if i == axis else None for i in range(5)))


# u8[agent, tool, food]: the outcomes of one action in every state of one layout.
_all_outcomes = jax.jit(_over_all(_over_all(_over_all(_outcome_code, 3), 2), 1))


def _expected_code(start: tt.State, corners: np.ndarray, action: tuple[int, int]) -> np.ndarray:
    layouts = spec.Layouts(np.asarray(start.board), np.asarray(start.tool_extent))
    tool = spec.Cell(*corners.T[:, None, :, None])
    food = spec.Cell(*CELLS.T[:, None, None, :])
    codes = []
    for agents in np.split(CELLS, 6):  # parts that fit the processor's cache
        agent = spec.Cell(*agents.T[:, :, None, None])
        moved = spec.step(layouts, agent, tool, food, action)
        code = moved.solved.view(np.uint8)
        for part in (moved.agent, moved.tool, moved.food):
            code = code + code + part.view(np.uint8)
        codes.append(code)
    return np.concatenate(codes)


def _assert_layout_agrees(start: tt.State) -> None:
    """All 16 actions in every state of a layout, reachable or not.

    Every agent cell, every tool place on the board and every food cell: a superset of
    whatever can be reached, so that no search decides what is compared.
    """
    corners = CELLS[np.all(CELLS + np.asarray(start.tool_extent) <= 12, axis=1)]
    for action in ALL_ACTIONS:
        pending = _all_outcomes(start, CELLS, corners, CELLS, jnp.array(action))
        expected = _expected_code(start, corners, action)  # while the device computes
        got = np.asarray(pending)
        if not np.array_equal(got, expected):
            agent, tool, food = np.argwhere(got != expected)[0]
            raise AssertionError(
                f"action {action}, agent {CELLS[agent]}, tool {corners[tool]}, food {CELLS[food]}: "
                f"{got[agent, tool, food]:#x}, specified {expected[agent, tool, food]:#x}\n"
                f"{tt.render_ascii(start)}"
            )


def _layouts(task: str, number: int) -> list[tt.State]:
    if task == "sy":  # all there are
        return [swap_with_tool(tt.base_state(), jnp.int32(code)) for code in SYMBOLIC_OBJECTS]
    keys = jax.random.split(jax.random.key(2019), number)
    states = jax.jit(jax.vmap(tt.make(task).reset))(keys)[0]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], states) for i in range(number)]


@pytest.mark.parametrize(
    ("task", "number"),
    [
        ("sy", 5),  # base among them
        ("p", 2),
        ("psy", 2),
        pytest.param("p", 70, marks=pytest.mark.slow),
        pytest.param("psy", 30, marks=pytest.mark.slow),
    ],
)
def test_every_action_in_every_state_agrees_with_the_specification(task, number):
    for layout in _layouts(task, number):
        _assert_layout_agrees(layout)


class Case(NamedTuple):
    """The top-left corner of a board, else ground, before and after one step.

    `agent` and `food` place what is not drawn because it lies under the tool or in an exit.
    """

    before: str
    action: tuple[int, int]
    after: str
    reward: int = 0
    agent: tuple[int, int] | None = None
    food: tuple[int, int] | None = None


CASES = {
    "moves over ground": Case("A..", (LEFT, RIGHT), ".A."),
    "stops at the edge": Case("A..", (LEFT, UP), "A.."),
    "stops at a tube": Case("A1.", (LEFT, RIGHT), "A1."),
    "stops at a trap": Case("Ax.", (LEFT, RIGHT), "Ax."),
    "stops at an exit": Case("Ae.", (LEFT, RIGHT), "Ae."),
    "stops at a tool it does not grasp": Case("AT.", (LEFT, RIGHT), "AT."),
    "walks along a tool it does not grasp": Case("AT/.T", (LEFT, DOWN), ".T/AT"),
    "carries the tool": Case("AT/.T/..", (RIGHT, DOWN), "../AT/.T"),
    "pulls the tool": Case(".AT/..T", (RIGHT, LEFT), "AT./.T."),
    "pushes the tool": Case("AT../.T..", (RIGHT, RIGHT), ".AT./..T."),
    "pushes the tool endwise": Case("ATTT.", (RIGHT, RIGHT), ".ATTT"),
    "is held by a tool at the edge": Case("T../TA.", (LEFT, UP), "T../TA."),
    "carries no tool to where it cannot walk": Case("1../AT.", (RIGHT, UP), "1../AT."),
    "slides the tool over a tube": Case("AT1/.T1", (RIGHT, RIGHT), ".AT/..T"),
    "slides the tool over trap and exit": Case("ATx/.Te", (RIGHT, RIGHT), ".AT/..T"),
    "pushes food": Case("ATF.", (RIGHT, RIGHT), ".ATF"),
    "pushes food with the far end": Case("AT../.TF.", (RIGHT, RIGHT), ".AT./..TF"),
    "pushes food into the exit": Case("ATFe", (RIGHT, RIGHT), ".ATF"),
    "pushes food out of the exit": Case("ATe./", (RIGHT, RIGHT), ".ATF", food=(0, 2)),
    "is held by food before a tube": Case("ATF1", (RIGHT, RIGHT), "ATF1"),
    "is held by food before a trap": Case("ATFx", (RIGHT, RIGHT), "ATFx"),
    "is held by food at the edge": Case("F../T../A..", (UP, UP), "F../T../A.."),
    "leaves food beside the tool": Case("AT./.F.", (RIGHT, RIGHT), ".AT/.F."),
    "takes food": Case("AF.", (LEFT, RIGHT), ".A.", reward=1),
    "takes food while it pulls the tool": Case("TAF.", (LEFT, RIGHT), ".TA.", reward=1),
    "takes food out of the exit": Case("Ae.", (LEFT, RIGHT), ".A.", reward=1, food=(0, 1)),
    "takes none out of it while grasping": Case("TAe", (LEFT, RIGHT), "TAF", food=(0, 2)),
    "grasps nothing from above the tool": Case("TT./...", (LEFT, DOWN), "TT./.A.", agent=(0, 1)),
}


def _from_corner(case: Case) -> tt.State:
    rows = [row.ljust(12, ".") for row in case.before.split("/")]
    rows += ["." * 12] * (12 - len(rows))
    drawn = "".join(rows)
    far_food = None if "F" in drawn else (11, 11)
    far_tool = {} if "T" in drawn else {"tool": (8, 8), "tool_extent": (1, 1)}
    return tt.State.from_ascii(rows, agent=case.agent, food=case.food or far_food, **far_tool)


@pytest.fixture(scope="module")
def step():
    return jax.jit(ENV.step)


@pytest.mark.parametrize("name", CASES)
def test_a_step_changes_the_board_as_the_rules_say(step, name):
    case = CASES[name]
    after, timestep = step(_from_corner(case), jnp.array(case.action))
    picture = tt.render_ascii(after).splitlines()
    expected = case.after.split("/")
    assert [row[: len(expected[0])] for row in picture[: len(expected)]] == expected
    assert timestep.reward == case.reward


@pytest.mark.parametrize("number", [-1, 4, 2**31 - 1])
def test_traced_numbers_that_are_no_direction_do_nothing(step, number):
    start = _from_corner(Case("ATF.", (0, 0), ""))
    moved_nowhere, _ = step(start, jnp.array((RIGHT, number)))
    grasped_nothing, _ = step(start, jnp.array((number, RIGHT)))
    assert tt.render_ascii(moved_nowhere) == tt.render_ascii(start)
    assert tt.render_ascii(grasped_nothing) == tt.render_ascii(start)
    assert (moved_nowhere.time, grasped_nothing.time) == (1, 1)
