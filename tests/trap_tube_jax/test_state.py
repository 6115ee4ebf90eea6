"""Building states, from arrays and from pictures, and the refusal of broken ones."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helpers.spec_reference as spec
import trap_tube_jax as tt
from helpers.refusal import assert_refused

PICTURE = (
    "............",
    "............",
    "............",
    "............",
    ".T..1111....",
    ".T..xF.e....",
    ".T..x..e....",
    ".T..2222....",
    "............",
    ".A..........",
    "............",
    "............",
)
BOARD = np.asarray(tt.base_state().board)
CELLS = ("agent", "tool", "tool_extent", "food")


def good_arrays(**changes: Any) -> dict[str, Any]:
    arrays = {
        "board": BOARD,
        "agent": (9, 1),
        "tool": (4, 1),
        "tool_extent": (4, 1),
        "food": (5, 5),
        "palette": spec.BASE_COLORS,
    }
    return arrays | changes


def board_with(value: int) -> np.ndarray:
    board = BOARD.astype(np.int64)
    board[2, 3] = value
    return board


def test_base_task_is_the_specified_one():
    state = tt.base_state()
    board = np.zeros((12, 12), np.uint8)
    board[4, 4:8] = spec.TUBE1
    board[7, 4:8] = spec.TUBE2
    board[5:7, 4] = spec.TRAP
    board[5:7, 7] = spec.EXIT
    cells = {name: np.array(good_arrays()[name], np.int32) for name in CELLS}
    flags = {"time": np.int32(0), "terminated": np.bool_(False), "truncated": np.bool_(False)}
    fields: dict[str, Any] = {"board": board, "palette": spec.BASE_COLORS, **cells, **flags}
    assert state == tt.State(**fields)
    assert all(isinstance(field, jax.Array) for field in jax.tree.leaves(state))


def test_all_ways_to_build_a_state_agree():
    empty = [re.sub("[AFT]", ".", row) for row in PICTURE]
    cells = {name: good_arrays()[name] for name in CELLS}
    for state in (
        tt.State.create(**good_arrays(board=BOARD.tolist())),
        tt.State.create(**cells, board=BOARD),
        tt.State.from_ascii(PICTURE),
        tt.State.from_ascii("\n".join(PICTURE)),
        tt.State.from_ascii(empty, **cells),
    ):
        assert state == tt.base_state()


def test_food_in_an_exit_and_a_tool_over_anything_are_allowed():
    state = tt.State.create(**good_arrays(food=(5, 7), tool=(4, 4), tool_extent=(1, 4)))
    assert tt.validate(state) is state
    over_agent = tt.State.create(**good_arrays(tool=(9, 1), tool_extent=(1, 1)))
    assert tt.validate(over_agent) is over_agent


@pytest.mark.parametrize("extent", [(1, 1), (1, 4), (4, 1), (2, 1), (1, 3)])
def test_a_tool_may_reach_the_last_cell(extent):
    corner = (12 - extent[0], 12 - extent[1])
    state = tt.State.create(**good_arrays(tool=corner, tool_extent=extent))
    np.testing.assert_array_equal(state.tool, corner)


# Invalid arrays, and words of the error.
BAD_ARRAYS = [
    ({"board": BOARD[1:]}, ["board", "[12, 12]", "[11, 12]"]),
    ({"board": BOARD * 1.0}, ["board", "integers", "float64"]),
    ({"board": BOARD > 0}, ["board", "integers", "bool"]),
    ({"board": PICTURE}, ["board", "integers"]),
    ({"board": None}, ["board", "integers", "None"]),
    ({"board": [[0] * 12, [0] * 11]}, ["board", "rectangular"]),
    ({"board": board_with(5)}, ["5", "row 2, column 3", "4 tube2"]),
    ({"board": board_with(-1)}, ["board", "-1", "0 to 255"]),
    ({"board": board_with(256)}, ["board", "256", "0 to 255"]),
    ({"palette": spec.BASE_COLORS[:7]}, ["palette", "[8, N]", "[7, 3]"]),
    ({"palette": np.zeros((8, 0), int)}, ["[8, N]", "[8, 0]"]),
    ({"palette": spec.BASE_COLORS + 0.5}, ["palette", "integers", "float"]),
    ({"agent": (12, 0)}, ["agent", "(12, 0)", "0 to 11"]),
    ({"agent": (3, -1)}, ["agent", "(3, -1)", "0 to 11"]),
    ({"agent": (4, 4)}, ["agent", "(4, 4)", "tube1", "allowed: ground"]),
    ({"agent": (5, 7)}, ["agent", "(5, 7)", "exit", "allowed: ground"]),
    ({"agent": (5, 5)}, ["agent and food", "(5, 5)", "apart"]),
    ({"agent": (9.5, 1.0)}, ["agent", "integers", "9.5"]),
    ({"agent": [(9, 1), (9, 2)]}, ["agent", "[2]", "[2, 2]"]),
    ({"food": (7, 5)}, ["food", "(7, 5)", "tube2", "ground or exit"]),
    ({"food": (6, 4)}, ["food", "(6, 4)", "trap", "ground or exit"]),
    ({"food": (0, 12)}, ["food", "(0, 12)", "0 to 11"]),
    ({"food": (0, 2**40)}, ["food", str(2**40), "allowed"]),
    ({"tool": (9, 1)}, ["tool", "(9, 1)", "(4, 1)", "0 to 11"]),
    ({"tool": (-1, 1)}, ["tool", "(-1, 1)", "0 to 11"]),
    ({"tool_extent": (2, 2)}, ["tool_extent", "(2, 2)", "1 to 4"]),
    ({"tool_extent": (1, 5)}, ["tool_extent", "(1, 5)", "1 to 4"]),
    ({"tool_extent": (0, 1)}, ["tool_extent", "(0, 1)", "1 to 4"]),
    ({"tool_extent": 4}, ["tool_extent", "[2]", "[]"]),
]


@pytest.mark.parametrize(("changes", "words"), BAD_ARRAYS)
def test_invalid_arrays_are_refused(changes, words):
    assert_refused(words, tt.State.create, **good_arrays(**changes))


# The picture, or rows of it that differ; keywords; and the message's words.
BAD_PICTURES: list[tuple[Any, dict[str, Any], list[str]]] = [
    (None, {}, ["must have 12 rows", "NoneType"]),
    (PICTURE[:11], {}, ["12 rows", "11"]),
    ("\n".join([*PICTURE, "." * 12]), {}, ["12 rows", "13"]),
    ({3: "." * 13}, {}, ["row 3", "12 characters", "'.............'"]),
    ({2: 7}, {}, ["row 2", "12 characters", "7"]),
    ({8: "....?......."}, {}, ["row 8, column 4", "'?'", "'x' trap", "'A' agent"]),
    ({0: "A..........."}, {}, ["agent 'A'", "one cell", "got 2", "(0, 0), (9, 1)"]),
    ({9: "............"}, {}, ["agent 'A'", "got 0", "agent="]),
    ({0: "F..........."}, {}, ["food 'F'", "one cell", "got 2", "(0, 0), (5, 5)"]),
    ({5: ".T..x..e...."}, {}, ["food 'F'", "got 0", "food="]),
    ({7: "..T.2222...."}, {}, ["(7, 2)", "straight bar", "1 to 4"]),
    ({6: "....x..e...."}, {}, ["(7, 1)", "straight bar", "1 to 4"]),
    ({8: ".T.........."}, {}, ["(5, 1)", "1 to 4"]),
    ([row.replace("T", ".") for row in PICTURE], {}, ["tool 'T'", "tool=", "tool_extent="]),
    ({}, {"tool": (0, 0)}, ["tool and tool_extent", "together"]),
    ({}, {"tool": (0, 0), "tool_extent": (1, 1)}, ["tool", "(0, 0)", "(4, 1)", "one of the two"]),
    ({}, {"agent": (0, 0)}, ["agent", "(0, 0)", "(9, 1)", "one of the two"]),
    ({}, {"palette": [1, 2, 3]}, ["palette", "[8, N]", "[3]"]),
]


@pytest.mark.parametrize(("rows", "keywords", "words"), BAD_PICTURES)
def test_from_ascii_refuses(rows, keywords, words):
    if isinstance(rows, dict):
        rows = [rows.get(index, row) for index, row in enumerate(PICTURE)]
    assert_refused(words, tt.State.from_ascii, rows, **keywords)


# Invalid fields, and words of the error.
BAD_FIELDS: list[tuple[dict[str, Any], list[str]]] = [
    ({"board": BOARD.astype(np.int32)}, ["state.board", "uint8[12, 12]", "int32[12, 12]"]),
    ({"agent": np.zeros((5, 2), np.int32)}, ["state.agent", "int32[5, 2]"]),
    ({"time": np.float32(0)}, ["state.time", "int32[]", "float32[]"]),
    ({"terminated": np.int32(0)}, ["state.terminated", "bool[]", "int32[]"]),
    ({"food": (5, 5)}, ["state.food", "array", "tuple"]),
    ({"palette": np.zeros(8, np.uint8)}, ["state.palette", "uint8[8, N]", "[8]"]),
    ({"terminated": np.array(True)}, ["terminated", "unfinished"]),
    ({"truncated": np.array(True)}, ["truncated", "unfinished"]),
]


@pytest.mark.parametrize(("changes", "words"), BAD_FIELDS)
def test_validate_refuses(changes, words):
    assert_refused(words, tt.validate, tt.base_state().replace(**changes))


@pytest.mark.parametrize("number", [0, 2.0, "3", True, None])
def test_base_palette_refuses(number):
    assert_refused(["num_features", ">= 1", repr(number)], tt.base_palette, number)


TAKE_A_STATE = [
    *(tt.observe, tt.visible_objects, tt.render_ascii, tt.render),
    lambda states: tt.episode_frames(states, []),
    lambda states: tt.make("base").step(states, jnp.array((0, 3))),
    *(
        lambda states, transfer=transfer: transfer(jax.random.key(0), states)
        for transfer in (
            *(tt.perceptual, tt.structural, tt.symbolic),
            *(tt.graded_perceptual(0.5), tt.graded_structural(0.5)),
            *tt.task_set("trap-turned").transfers,
        )
    ),
]


@pytest.mark.parametrize("function", [tt.validate, *TAKE_A_STATE])
def test_functions_of_one_state_refuse_a_batch_and_other_things(function):
    states = jax.tree.map(lambda x: np.stack([x] * 4), tt.base_state())
    words = ["state.board must be uint8[12, 12], got uint8[4, 12, 12]", "use jax.vmap"]
    assert_refused(words, function, states)
    assert_refused(["expected a trap_tube_jax.State, got str"], function, "TrapTube-v0")
    words = ["expected a trap_tube_jax.State, got tuple", "return (state, timestep)"]
    assert_refused(words, function, (tt.base_state(), None))


@pytest.mark.parametrize(
    ("make", "path"), [(tt.AutoReset, "inner"), (tt.VectorEnvironment, "episodes.inner")]
)
def test_a_state_that_holds_another_is_refused_with_the_path_to_it(make, path):
    key = jax.random.key(0)
    keys = key if make is tt.AutoReset else jax.random.split(key, 1)
    state, _ = make(tt.make("base")).reset(keys)
    assert_refused([f"got {type(state).__name__}; take its `{path}`"], tt.render, state)
