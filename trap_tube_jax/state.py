"""The state of one task, built from arrays or from a picture.

Source: environment.md, "Board and objects" and "Base task".
"""

import functools
from collections.abc import Sequence
from typing import Any, Self

import jax
import numpy as np
from flax import struct

from trap_tube_jax.by_value import ByValue
from trap_tube_jax.checks import described, integer_array
from trap_tube_jax.objects import (
    AGENT,
    BOARD_SIZE,
    EXIT,
    FOOD,
    GROUND,
    MAX_TOOL_LENGTH,
    NUM_OBJECTS,
    OBJECT_CHARS,
    OBJECT_NAMES,
    STATIC_OBJECTS,
    TOOL,
    base_palette,
)

BOARD_SHAPE = (BOARD_SIZE, BOARD_SIZE)


class State(ByValue, struct.PyTreeNode, eq=False):
    """One task at one time: everything the dynamics and the observation depend on.

    Attributes:
      board: u8[12, 12], the code (0 to 4) of the static object in every cell.
      palette: u8[8, N], the features of every object code.
      agent: i32[2], the agent's (row, column).
      tool: i32[2], the (row, column) of the tool's top-left cell.
      tool_extent: i32[2], the tool's (rows, columns); one of them is 1.
      food: i32[2], the food's (row, column).
      time: i32[], steps taken in this episode.
      terminated: bool[], the agent has reached the food.
      truncated: bool[], the step limit ended the episode without success.
    """

    board: jax.Array
    palette: jax.Array
    agent: jax.Array
    tool: jax.Array
    tool_extent: jax.Array
    food: jax.Array
    time: jax.Array
    terminated: jax.Array
    truncated: jax.Array

    @classmethod
    def create(
        cls,
        *,
        board: Any,
        agent: Any,
        tool: Any,
        tool_extent: Any,
        food: Any,
        palette: Any = None,
    ) -> Self:
        """Builds a state at time 0 from concrete arrays of any integer type.

        The tool may cover anything, the agent included, and the food may be in an exit. Any
        number of cells may hold each static object.

        Args:
          board: [12, 12], codes 0 to 4.
          agent: (row, column), on ground and not on the food.
          tool: (row, column) of the tool's top-left cell.
          tool_extent: (rows, columns), a bar of 1 to 4 cells that fits on the board.
          food: (row, column), on ground or exit.
          palette: [8, N] with values 0 to 255; the base colours if absent.

        Raises:
          ValueError: naming the value and what is allowed.
        """
        fields: dict[str, Any] = {
            "board": _integers("board", board, BOARD_SHAPE, np.uint8),
            "palette": _integers(
                "palette",
                base_palette() if palette is None else palette,
                (NUM_OBJECTS, None),
                np.uint8,
            ),
            "agent": _integers("agent", agent, (2,), np.int32),
            "tool": _integers("tool", tool, (2,), np.int32),
            "tool_extent": _integers("tool_extent", tool_extent, (2,), np.int32),
            "food": _integers("food", food, (2,), np.int32),
            "time": np.zeros((), np.int32),
            "terminated": np.zeros((), np.bool_),
            "truncated": np.zeros((), np.bool_),
        }
        # A layout is concrete also where it is built inside a traced function.
        with jax.ensure_compile_time_eval():
            return jax.device_put(validate(cls(**fields)))

    @classmethod
    def from_ascii(
        cls,
        rows: str | Sequence[str],
        *,
        agent: Any = None,
        tool: Any = None,
        tool_extent: Any = None,
        food: Any = None,
        palette: Any = None,
    ) -> Self:
        """Builds a state at time 0 from a picture of 12 rows of 12 characters.

        `.` ground, `x` trap, `e` exit, `1` and `2` the tubes, `F` food, `T` tool, `A` agent.
        Drawn food, tool and agent stand on ground. Give by keyword, and do not draw, what
        covers another object.

        Args:
          rows: the picture, as one string (blank margins are dropped) or as rows.
          agent: (row, column), if not drawn.
          tool: (row, column) of the top-left cell, if not drawn.
          tool_extent: (rows, columns) of the tool, with `tool` only.
          food: (row, column), if not drawn.
          palette: [8, N]; the base colours if absent.

        Raises:
          ValueError: naming the offending row and character, or the value, and what
            is allowed.
        """
        codes = _parse_picture(rows)
        if (tool is None) != (tool_extent is None):
            raise ValueError("tool and tool_extent are given together or not at all")
        if tool is None:
            tool, tool_extent = _drawn_bar(codes)
        else:
            _refuse_drawn(codes, TOOL, tool)
        return cls.create(
            board=np.where(codes < FOOD, codes, GROUND),
            agent=_drawn_cell(codes, AGENT, agent),
            tool=tool,
            tool_extent=tool_extent,
            food=_drawn_cell(codes, FOOD, food),
            palette=palette,
        )


class TimeStep(ByValue, struct.PyTreeNode, eq=False):
    """Observation, reward and flags after a reset or a step.

    Attributes:
      observation: u8[12, 12, N], the coloured board.
      reward: f32[], 1 on success, else 0.
      terminated: bool[], the task is solved.
      truncated: bool[], the step limit is reached without success.
      discount: f32[], 0 where `terminated`, else 1: the weight of future rewards.
    """

    observation: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    discount: jax.Array

    @property
    def done(self) -> jax.Array:
        """Whether the episode is over, bool[]: terminated or truncated."""
        return self.terminated | self.truncated


def base_state(num_features: int = 3) -> State:
    """Builds the base task in base colours of N features; environment.md, "Base task"."""
    return State.from_ascii(
        """
        ............
        ............
        ............
        ............
        .T..1111....
        .T..xF.e....
        .T..x..e....
        .T..2222....
        ............
        .A..........
        ............
        ............
        """,
        palette=base_palette(num_features),
    )


def validate(state: State) -> State:
    """Returns `state` if it is a valid task whose episode is not over.

    Args:
      state: one unbatched state of concrete arrays.

    Raises:
      ValueError: a field has the wrong type, shape or dtype, the episode is over, an
        object is off the board or where it cannot be; the message says what is allowed.
    """
    check_structure(state)
    for flag in ("terminated", "truncated"):
        if getattr(state, flag):
            raise ValueError(f"the state is {flag}; allowed: one whose episode is not over")
    fields = (state.board, state.tool, state.tool_extent)
    board, tool, extent = (np.asarray(field, np.int64) for field in fields)  # sums stay exact
    if board.max() > max(STATIC_OBJECTS):
        row, column = np.argwhere(board > max(STATIC_OBJECTS))[0]
        allowed = ", ".join(f"{code} {OBJECT_NAMES[code]}" for code in STATIC_OBJECTS)
        raise ValueError(
            f"board holds {board[row, column]} at row {row}, column {column}; allowed: {allowed}"
        )
    if extent.min() != 1 or extent.max() > MAX_TOOL_LENGTH:
        raise ValueError(
            f"tool_extent is {tuple(extent.tolist())}; allowed: a bar of 1 to "
            f"{MAX_TOOL_LENGTH} cells, (length, 1) or (1, length)"
        )
    if tool.min() < 0 or (tool + extent).max() > BOARD_SIZE:
        raise ValueError(
            f"tool at {tuple(tool.tolist())} with extent {tuple(extent.tolist())} leaves the "
            f"board; all its cells must be in rows and columns 0 to {BOARD_SIZE - 1}"
        )
    _check_stands_on("agent", state.agent, board, (GROUND,))
    _check_stands_on("food", state.food, board, (GROUND, EXIT))
    if np.array_equal(state.agent, state.food):
        raise ValueError(
            f"agent and food share cell {tuple(np.asarray(state.food).tolist())}: "
            "the task would be solved before it starts; place them apart"
        )
    return state


def check_structure(state: Any) -> None:
    """Checks that `state` is a `State` whose fields have the right shapes and dtypes.

    Args:
      state: arrays, tracers or `jax.ShapeDtypeStruct` in the fields.

    Raises:
      ValueError: naming the field, what it is and what it must be.
    """
    check_state(state)
    for name, (shape, dtype) in _field_specs(np.shape(state.palette)[-1]).items():
        field = getattr(state, name)
        if not hasattr(field, "shape") or not hasattr(field, "dtype"):
            raise ValueError(f"state.{name} must be an array, got {type(field).__name__}")
        if field.dtype != dtype:
            raise ValueError(
                f"state.{name} must be {np.dtype(dtype).name}{list(shape)}, got {described(field)}"
            )


def check_state(state: Any) -> None:
    """Checks type and shapes of one unbatched `State`.

    The check must be quick: every function of one state makes it when called or traced.

    Raises:
      ValueError: naming the field, what it is and what it must be.
    """
    if not isinstance(state, State):
        hint = "; reset and step return (state, timestep)" if isinstance(state, tuple) else ""
        raise ValueError(f"expected a trap_tube_jax.State, got {type(state).__name__}{hint}")
    shape = np.shape(state.palette)
    num_features = shape[-1] if len(shape) > 1 else 3
    for name, (shape, dtype) in _field_specs(max(num_features, 1)).items():
        field = getattr(state, name)
        found = np.shape(field)
        if found != shape:
            kind = getattr(field, "dtype", type(field).__name__)
            hint = "; for a batch of states use jax.vmap" if _is_batch_of(shape, found) else ""
            raise ValueError(
                f"state.{name} must be {np.dtype(dtype).name}{list(shape)}, "
                f"got {kind}{list(found)}{hint}"
            )


def _is_batch_of(shape: tuple[int, ...], found: tuple[int, ...]) -> bool:
    return len(found) > len(shape) and found[len(found) - len(shape) :] == shape


@functools.cache
def _field_specs(num_features: int) -> dict[str, tuple[tuple[int, ...], type]]:
    cell = ((2,), np.int32)
    flag = ((), np.bool_)
    return {
        "board": (BOARD_SHAPE, np.uint8),
        "palette": ((NUM_OBJECTS, num_features), np.uint8),
        "agent": cell,
        "tool": cell,
        "tool_extent": cell,
        "food": cell,
        "time": ((), np.int32),
        "terminated": flag,
        "truncated": flag,
    }


def _integers(name: str, value: Any, shape: tuple[int | None, ...], dtype: type) -> Any:
    """Converts `value` to `dtype` after checking kind, shape (None: any >= 1) and range."""
    array = np.asarray(integer_array(name, value))
    wanted = ", ".join("N >= 1" if size is None else str(size) for size in shape)
    matches = array.ndim == len(shape) and all(
        size == want if want is not None else size >= 1
        for size, want in zip(array.shape, shape, strict=True)
    )
    if not matches:
        raise ValueError(f"{name} must have shape ({wanted}), got {array.shape}")
    limits = np.iinfo(dtype)
    if array.min() < limits.min or array.max() > limits.max:
        outside = array[(array < limits.min) | (array > limits.max)][0]
        raise ValueError(f"{name} holds {outside}; allowed: {limits.min} to {limits.max}")
    return array.astype(dtype)


def _check_stands_on(name: str, cell: Any, board: np.ndarray, allowed: tuple[int, ...]) -> None:
    row, column = np.asarray(cell).tolist()
    if not (0 <= row < BOARD_SIZE and 0 <= column < BOARD_SIZE):
        raise ValueError(
            f"{name} at ({row}, {column}) is off the board; rows and columns go from 0 to "
            f"{BOARD_SIZE - 1}"
        )
    code = int(board[row, column])
    if code not in allowed:
        names = " or ".join(OBJECT_NAMES[code] for code in allowed)
        raise ValueError(
            f"{name} at ({row}, {column}) stands on {OBJECT_NAMES[code]}; allowed: {names}"
        )


def _parse_picture(rows: str | Sequence[str]) -> np.ndarray:
    """Reads the object codes u8[12, 12] of a picture."""
    if isinstance(rows, str):
        rows = [line.strip() for line in rows.strip().splitlines()]
    if not isinstance(rows, Sequence):
        raise ValueError(f"the picture must be one string or rows, got {type(rows).__name__}")
    if len(rows) != BOARD_SIZE:
        raise ValueError(f"the picture must have {BOARD_SIZE} rows, got {len(rows)}")
    for index, line in enumerate(rows):
        if not isinstance(line, str):
            raise ValueError(f"row {index} must be a string, got {type(line).__name__}")
        if len(line) != BOARD_SIZE:
            raise ValueError(
                f"row {index} must have {BOARD_SIZE} characters, got {len(line)}: {line!r}"
            )
        for column, char in enumerate(line):
            if char not in OBJECT_CHARS:
                allowed = ", ".join(
                    f"{char!r} {name}"
                    for char, name in zip(OBJECT_CHARS, OBJECT_NAMES, strict=True)
                )
                raise ValueError(
                    f"row {index}, column {column}: unknown character {char!r}; allowed: {allowed}"
                )
    return np.array([[OBJECT_CHARS.index(char) for char in line] for line in rows], np.uint8)


def _refuse_drawn(codes: np.ndarray, code: int, given: Any) -> None:
    drawn = np.argwhere(codes == code)
    if len(drawn):
        raise ValueError(
            f"{OBJECT_NAMES[code]} is given as {given} and drawn at "
            f"{tuple(drawn[0].tolist())}; allowed: one of the two"
        )


def _drawn_cell(codes: np.ndarray, code: int, given: Any) -> Any:
    """Returns the only cell drawn as `code`, or `given`."""
    if given is not None:
        _refuse_drawn(codes, code, given)
        return given
    drawn = np.argwhere(codes == code)
    if len(drawn) != 1:
        name, char = OBJECT_NAMES[code], OBJECT_CHARS[code]
        cells = [tuple(cell) for cell in drawn.tolist()]
        raise ValueError(
            f"the picture must hold exactly one {name} {char!r}, got {len(drawn)}: {cells}; "
            f"or none, with {name}= given"
        )
    return drawn[0]


def _drawn_bar(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns corner and extent of the cells drawn as tool, which must form a bar."""
    drawn = np.argwhere(codes == TOOL)
    if not len(drawn):
        raise ValueError(
            f"the picture must hold the tool {OBJECT_CHARS[TOOL]!r}, or tool= and tool_extent= "
            "be given"
        )
    corner = drawn.min(axis=0)
    extent = drawn.max(axis=0) - corner + 1
    if extent.prod() != len(drawn):
        cells = [tuple(cell) for cell in drawn.tolist()]
        raise ValueError(
            f"the tool is drawn at {cells}; allowed: one straight bar of 1 to "
            f"{MAX_TOOL_LENGTH} neighbouring cells"
        )
    return corner, extent
