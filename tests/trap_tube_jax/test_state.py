"""Building states, from arrays and from pictures, and the refusal of broken ones."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import spec_reference as spec
import trap_tube_jax as tt
from refusal import assert_refused

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
FIELDS = [field.name for field in dataclasses.fields(tt.State)]


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


def board_with(value: int, dtype: type = np.int64) -> np.ndarray:
    board = BOARD.astype(dtype)
    board[2, 3] = value
    return board


def palette_with(value: float, dtype: type = np.int64) -> np.ndarray:
    palette = spec.BASE_COLORS.astype(dtype)
    palette[1, 2] = value
    return palette


def picture_with(row: int, line: Any) -> list[Any]:
    return [line if index == row else old for index, old in enumerate(PICTURE)]


def assert_states_equal(state: tt.State, other: tt.State) -> None:
    for name in FIELDS:
        left, right = getattr(state, name), getattr(other, name)
        assert (left.dtype, left.shape) == (right.dtype, right.shape), name
        np.testing.assert_array_equal(left, right, err_msg=name)


def test_base_task_is_the_specified_one():
    state = tt.base_state()
    board = np.zeros((12, 12), int)
    board[4, 4:8], board[7, 4:8] = spec.TUBE1, spec.TUBE2
    board[5:7, 4], board[5:7, 7] = spec.TRAP, spec.EXIT
    np.testing.assert_array_equal(state.board, board)
    np.testing.assert_array_equal(state.palette, spec.BASE_COLORS)
    for name, value in good_arrays().items():
        if name not in ("board", "palette"):
            np.testing.assert_array_equal(getattr(state, name), value, err_msg=name)
    assert (state.time, state.terminated, state.truncated) == (0, False, False)


def test_create_and_from_ascii_agree():
    state = tt.State.create(**good_arrays())
    assert_states_equal(state, tt.base_state())
    assert_states_equal(state, tt.State.from_ascii(PICTURE))
    assert_states_equal(state, tt.State.from_ascii("\n".join(PICTURE)))
    undrawn = tt.State.create(**{k: v for k, v in good_arrays().items() if k != "palette"})
    assert_states_equal(state, undrawn)


def test_fields_have_their_documented_types():
    state = tt.State.create(**good_arrays(board=BOARD.tolist(), palette=np.zeros((8, 5), int)))
    documented = {
        "board": ("uint8", (12, 12)),
        "palette": ("uint8", (8, 5)),
        "agent": ("int32", (2,)),
        "tool": ("int32", (2,)),
        "tool_extent": ("int32", (2,)),
        "food": ("int32", (2,)),
        "time": ("int32", ()),
        "terminated": ("bool", ()),
        "truncated": ("bool", ()),
    }
    assert sorted(documented) == sorted(FIELDS)
    for name, (dtype, shape) in documented.items():
        field = getattr(state, name)
        assert isinstance(field, jax.Array), name
        assert (field.dtype.name, field.shape) == (dtype, shape), name


def test_what_is_not_drawn_is_given():
    drawn = [row.replace("A", ".").replace("F", ".").replace("T", ".") for row in PICTURE]
    given = tt.State.from_ascii(drawn, agent=(9, 1), tool=(4, 1), tool_extent=(4, 1), food=(5, 5))
    assert_states_equal(given, tt.base_state())


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


def test_states_can_be_built_while_tracing():
    """A layout written inside a jitted function is a constant of it."""
    time = jax.jit(lambda: tt.base_state().replace(time=jnp.int32(7)).time)()
    assert time == 7


# What is wrong, what is passed instead of the good arrays, and the message's words.
BAD_ARRAYS = [
    ("board too small", {"board": BOARD[1:]}, ["board", "[12, 12]", "[11, 12]"]),
    ("board flat", {"board": BOARD.ravel()}, ["board", "[12, 12]", "[144]"]),
    ("board of floats", {"board": BOARD * 1.0}, ["board", "integers", "float64"]),
    ("board of booleans", {"board": BOARD > 0}, ["board", "integers", "bool"]),
    ("board of text", {"board": PICTURE}, ["board", "integers"]),
    ("board missing", {"board": None}, ["board", "integers", "None"]),
    ("board ragged", {"board": [[0] * 12, [0] * 11]}, ["board", "rectangular"]),
    ("board with food's code", {"board": board_with(5)}, ["5", "row 2, column 3", "4 tube2"]),
    ("board below 0", {"board": board_with(-1)}, ["board", "-1", "0 to 255"]),
    ("board beyond a byte", {"board": board_with(256)}, ["board", "256", "0 to 255"]),
    ("palette of seven", {"palette": spec.BASE_COLORS[:7]}, ["palette", "[8, N]", "[7, 3]"]),
    ("palette flat", {"palette": spec.BASE_COLORS[:, 0]}, ["palette", "[8, N]", "[8]"]),
    ("palette of no feature", {"palette": np.zeros((8, 0), int)}, ["[8, N]", "[8, 0]"]),
    ("palette above 255", {"palette": palette_with(256)}, ["palette", "256", "0 to 255"]),
    ("palette below 0", {"palette": palette_with(-3)}, ["palette", "-3", "0 to 255"]),
    ("palette of floats", {"palette": palette_with(0.5, float)}, ["palette", "integers", "float"]),
    ("agent below the board", {"agent": (12, 0)}, ["agent", "(12, 0)", "0 to 11"]),
    ("agent left of the board", {"agent": (3, -1)}, ["agent", "(3, -1)", "0 to 11"]),
    ("agent in a tube", {"agent": (4, 4)}, ["agent", "(4, 4)", "tube1", "allowed: ground"]),
    ("agent in the trap", {"agent": (5, 4)}, ["agent", "(5, 4)", "trap", "allowed: ground"]),
    ("agent in the exit", {"agent": (5, 7)}, ["agent", "(5, 7)", "exit", "allowed: ground"]),
    ("agent on the food", {"agent": (5, 5)}, ["agent and food", "(5, 5)", "apart"]),
    ("agent of three numbers", {"agent": (9, 1, 0)}, ["agent", "[2]", "[3]"]),
    ("agent between cells", {"agent": (9.5, 1.0)}, ["agent", "integers", "9.5"]),
    ("two agents", {"agent": [(9, 1), (9, 2)]}, ["agent", "[2]", "[2, 2]"]),
    ("food in a tube", {"food": (7, 5)}, ["food", "(7, 5)", "tube2", "ground or exit"]),
    ("food in the trap", {"food": (6, 4)}, ["food", "(6, 4)", "trap", "ground or exit"]),
    ("food off the board", {"food": (0, 12)}, ["food", "(0, 12)", "0 to 11"]),
    ("food beyond 32 bits", {"food": (0, 2**40)}, ["food", str(2**40), "allowed"]),
    ("tool below the board", {"tool": (9, 1)}, ["tool", "(9, 1)", "(4, 1)", "0 to 11"]),
    ("tool above the board", {"tool": (-1, 1)}, ["tool", "(-1, 1)", "0 to 11"]),
    ("tool off 32 bits", {"tool": (2**31 - 1, 1)}, ["tool", str(2**31 - 1), "0 to 11"]),
    ("tool too wide", {"tool_extent": (2, 2)}, ["tool_extent", "(2, 2)", "1 to 4"]),
    ("tool too long", {"tool_extent": (1, 5)}, ["tool_extent", "(1, 5)", "1 to 4"]),
    ("tool of no cell", {"tool_extent": (0, 1)}, ["tool_extent", "(0, 1)", "1 to 4"]),
    ("tool's extent a number", {"tool_extent": 4}, ["tool_extent", "[2]", "[]"]),
]


@pytest.mark.parametrize(
    ("changes", "words"), [case[1:] for case in BAD_ARRAYS], ids=[case[0] for case in BAD_ARRAYS]
)
def test_create_refuses(changes, words):
    assert_refused(words, tt.State.create, **good_arrays(**changes))


# What is wrong, the picture, keywords, and the message's words.
BAD_PICTURES: list[tuple[str, Any, dict[str, Any], list[str]]] = [
    ("nothing", None, {}, ["one string or 12 rows", "NoneType"]),
    ("a row missing", PICTURE[:11], {}, ["12 rows", "11"]),
    ("a row too many", "\n".join([*PICTURE, "." * 12]), {}, ["12 rows", "13"]),
    (
        "a row too long",
        picture_with(3, "." * 13),
        {},
        ["row 3", "12 characters", "'.............'"],
    ),
    ("a row too short", picture_with(11, "..."), {}, ["row 11", "12 characters", "'...'"]),
    ("a row no text", picture_with(2, 7), {}, ["row 2", "12 characters", "7"]),
    (
        "an unknown character",
        picture_with(8, "....?......."),
        {},
        ["row 8, column 4", "'?'", "'x' trap", "'A' agent"],
    ),
    (
        "two agents",
        picture_with(0, "A..........."),
        {},
        ["agent 'A'", "one cell", "got 2", "(0, 0), (9, 1)"],
    ),
    ("no agent", picture_with(9, "." * 12), {}, ["agent 'A'", "got 0", "agent="]),
    (
        "two foods",
        picture_with(0, "F..........."),
        {},
        ["food 'F'", "one cell", "got 2", "(0, 0), (5, 5)"],
    ),
    ("no food", picture_with(5, ".T..x..e...."), {}, ["food 'F'", "got 0", "food="]),
    ("a bent tool", picture_with(7, "..T.2222...."), {}, ["(7, 2)", "straight bar", "1 to 4"]),
    ("a broken tool", picture_with(6, "....x..e...."), {}, ["(7, 1)", "straight bar", "1 to 4"]),
    ("a tool of five", picture_with(8, ".T.........."), {}, ["(5, 1)", "1 to 4"]),
    (
        "no tool",
        [row.replace("T", ".") for row in PICTURE],
        {},
        ["tool 'T'", "tool=", "tool_extent="],
    ),
    ("a tool of no extent", PICTURE, {"tool": (0, 0)}, ["tool and tool_extent", "together"]),
    (
        "an extent of no tool",
        PICTURE,
        {"tool_extent": (1, 1)},
        ["tool and tool_extent", "together"],
    ),
    (
        "the tool drawn and given",
        PICTURE,
        {"tool": (0, 0), "tool_extent": (1, 1)},
        ["tool", "(0, 0)", "(4, 1)", "one of the two"],
    ),
    (
        "the agent drawn and given",
        PICTURE,
        {"agent": (0, 0)},
        ["agent", "(0, 0)", "(9, 1)", "one of the two"],
    ),
    ("the food drawn and given", PICTURE, {"food": (0, 1)}, ["food", "(0, 1)", "(5, 5)"]),
    ("a palette of three", PICTURE, {"palette": [1, 2, 3]}, ["palette", "[8, N]", "[3]"]),
]


@pytest.mark.parametrize(
    ("rows", "keywords", "words"),
    [case[1:] for case in BAD_PICTURES],
    ids=[case[0] for case in BAD_PICTURES],
)
def test_from_ascii_refuses(rows, keywords, words):
    assert_refused(words, tt.State.from_ascii, rows, **keywords)


# Which fields of a good state are replaced by what, and the message's words.
BAD_FIELDS: list[tuple[str, dict[str, Any], list[str]]] = [
    (
        "board of i32",
        {"board": BOARD.astype(np.int32)},
        ["state.board", "uint8[12, 12]", "int32[12, 12]"],
    ),
    ("a batch of agents", {"agent": np.zeros((5, 2), np.int32)}, ["state.agent", "int32[5, 2]"]),
    ("time of f32", {"time": np.float32(0)}, ["state.time", "int32[]", "float32[]"]),
    ("a flag of i32", {"terminated": np.int32(0)}, ["state.terminated", "bool[]", "int32[]"]),
    ("no array", {"food": (5, 5)}, ["state.food", "array", "tuple"]),
    ("palette flat", {"palette": np.zeros(8, np.uint8)}, ["state.palette", "uint8[8, N]", "[8]"]),
    ("solved", {"terminated": np.array(True)}, ["terminated", "not over"]),
    ("timed out", {"truncated": np.array(True)}, ["truncated", "not over"]),
    ("tool off the board", {"tool": np.array((11, 11), np.int32)}, ["tool", "(11, 11)", "0 to 11"]),
    ("food in the trap", {"food": np.array((5, 4), np.int32)}, ["food", "(5, 4)", "trap"]),
]


@pytest.mark.parametrize(
    ("changes", "words"), [case[1:] for case in BAD_FIELDS], ids=[case[0] for case in BAD_FIELDS]
)
def test_validate_refuses(changes, words):
    assert_refused(words, tt.validate, tt.base_state().replace(**changes))


@pytest.mark.parametrize("value", [None, "TrapTube-v0", {"board": BOARD}])
def test_validate_refuses_what_is_no_state(value):
    assert_refused(["State", type(value).__name__], tt.validate, value)


@pytest.mark.parametrize("number", [0, -1, 2.0, "3", True, None])
def test_base_palette_refuses(number):
    assert_refused(["num_features", ">= 1", repr(number)], tt.base_palette, number)


@pytest.mark.parametrize(
    "function",
    [
        *(tt.observe, tt.visible_objects, tt.render_ascii, tt.render),
        lambda states: tt.make("base").step(states, jnp.array((0, 3))),
        *(
            lambda states, transfer=transfer: transfer(jax.random.key(0), states)
            for transfer in (
                *(tt.perceptual, tt.structural, tt.symbolic),
                *(tt.graded_perceptual(0.5), tt.graded_structural(0.5)),
                *tt.task_set("trap-turned").transfers,
            )
        ),
    ],
)
def test_functions_of_one_state_refuse_a_batch_and_a_pair(function):
    states = jax.tree.map(lambda x: np.stack([x] * 4), tt.base_state())
    words = ["state.board must be uint8[12, 12], got uint8[4, 12, 12]", "use jax.vmap"]
    assert_refused(words, function, states)
    words = ["expected a trap_tube_jax.State, got tuple", "return (state, timestep)"]
    assert_refused(words, function, (tt.base_state(), None))
