"""The state of one task, built from arrays or from a picture.

Source: environment.md, "Board and objects" and "Base task".
"""

import contextlib
import operator
from collections.abc import Iterable, Sequence
from typing import Any, Self, TypeVar

import jax
import numpy as np
from flax import struct

from trap_tube_jax.by_value import ByValue
from trap_tube_jax.checks import describe_array, integer_array
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

Record = TypeVar("Record")

# Shape and dtype of every field of a state; None stands for N >= 1 features.
_FIELDS: dict[str, tuple[tuple[int | None, ...], type]] = {
    "board": ((BOARD_SIZE, BOARD_SIZE), np.uint8),
    "palette": ((NUM_OBJECTS, None), np.uint8),
    **dict.fromkeys(("agent", "tool", "tool_extent", "food"), ((2,), np.int32)),
    "time": ((), np.int32),
    **dict.fromkeys(("terminated", "truncated"), ((), np.bool_)),
}


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

    Example:
      >>> state = tt.base_state()
      >>> state.agent.tolist(), state.food.tolist(), bool(state.done)
      ([9, 1], [5, 5], False)
      >>> state.replace(agent=jnp.array([0, 0])).agent.tolist()
      [0, 0]
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

    @property
    def done(self) -> jax.Array:
        """Returns bool[]: the episode is over, terminated or truncated."""
        return self.terminated | self.truncated

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

        The tool may cover anything, the agent included, and the food may be in an exit. A
        static object may fill any number of cells.

        Args:
          board: [12, 12], codes 0 to 4.
          agent: (row, column), on ground and not on the food.
          tool: (row, column) of the tool's top-left cell.
          tool_extent: (rows, columns), a bar of 1 to 4 cells that fits on the board.
          food: (row, column), on ground or exit.
          palette: [8, N] with values 0 to 255; the base colours if absent.

        Raises:
          ValueError: naming the value and what is allowed.

        Example:
          >>> board = np.zeros((12, 12), int)
          >>> state = tt.State.create(
          ...     board=board, agent=(0, 0), tool=(0, 3), tool_extent=(1, 2), food=(0, 11)
          ... )
          >>> tt.render_ascii(state).splitlines()[0]
          'A..TT......F'
        """
        given = {
            "board": board,
            "palette": base_palette() if palette is None else palette,
            "agent": agent,
            "tool": tool,
            "tool_extent": tool_extent,
            "food": food,
        }
        fields = {name: _convert(name, value) for name, value in given.items()}
        start: Any = {"time": np.int32(0), "terminated": np.False_, "truncated": np.False_}
        # Keep the layout concrete, even inside a traced function.
        with jax.ensure_compile_time_eval():
            return jax.device_put(validate(cls(**fields, **start)))

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

        `.` ground, `x` trap, `e` exit, `1` and `2` the tubes, `F` food, `T` tool, `A` agent. Cells
        drawn as `F`, `T` or `A` have ground below. To put one on another object, leave it out of
        the picture and pass its position by keyword.

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

        Example:
          >>> state = tt.State.from_ascii(["A..TT......F", *["." * 12] * 11])
          >>> state.tool.tolist(), state.tool_extent.tolist()
          ([0, 3], [1, 2])
        """
        codes = _parse_picture(rows)
        if (tool is None) != (tool_extent is None):
            raise ValueError("give tool and tool_extent together, or neither")
        tool, drawn_extent = _place(codes, TOOL, tool, MAX_TOOL_LENGTH)
        return cls.create(
            board=np.where(codes < FOOD, codes, GROUND),
            agent=_place(codes, AGENT, agent)[0],
            tool=tool,
            tool_extent=drawn_extent if tool_extent is None else tool_extent,
            food=_place(codes, FOOD, food)[0],
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

    Example:
      >>> state, timestep = tt.make("base").reset(jax.random.key(0))
      >>> timestep.observation.shape, float(timestep.discount), bool(timestep.done)
      ((12, 12, 3), 1.0, False)
    """

    observation: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    discount: jax.Array

    @property
    def done(self) -> jax.Array:
        """Returns bool[]: the episode is over, terminated or truncated."""
        return self.terminated | self.truncated


def base_state(num_features: int = 3) -> State:
    """Builds the base task in base colours of N features; environment.md, "Base task".

    Raises:
      ValueError: `num_features` is not an integer from 1 to 1024.

    Example:
      >>> state = tt.base_state()
      >>> state.tool.tolist(), state.tool_extent.tolist()
      ([4, 1], [4, 1])
    """
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


def take(batch: Record, index: Any) -> Record:
    """Indexes the first axis of a tree of arrays with an integer, a slice or integers."""
    return jax.tree.map(lambda field: field[index], batch)


def concatenate_trees(batches: Iterable[Record]) -> Record:
    """Joins trees of arrays along the first axis; returns NumPy arrays."""
    return jax.tree.map(lambda *parts: np.concatenate(parts), *batches)


def validate_batch(states: State, count: int, source: str) -> None:
    """Raises ValueError, which names the `source`, unless `count` concrete states are valid."""
    concrete = jax.device_get(states)
    for index in range(count):
        try:
            validate(take(concrete, index))
        except ValueError as error:
            raise ValueError(f"{source} drew an invalid state: {error}") from error


def validate(state: State) -> State:
    """Returns `state` if it is a valid task whose episode is not over.

    Args:
      state: one unbatched state of concrete arrays.

    Raises:
      ValueError: a field has the wrong type, shape or dtype, the episode is over, an
        object is off the board or where it cannot be; the message says what is allowed.

    Example:
      >>> tt.validate(tt.base_state().replace(agent=jnp.array([5, 4])))
      Traceback (most recent call last):
        ...
      ValueError: agent at (5, 4) stands on trap; allowed: ground
    """
    check_state(state)
    for flag in ("terminated", "truncated"):
        if getattr(state, flag):
            raise ValueError(f"the state is {flag}; give a state whose episode is unfinished")
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
            "the task would be solved before it starts; move them apart"
        )
    return state


BATCH_HINT = "this is a batch of states: take one, or use jax.vmap (for plans, solve_batch)"


def check_is_state(state: Any) -> None:
    """Raises ValueError unless `state` is a `State`."""
    if not isinstance(state, State):
        hint = "; reset and step return (state, timestep)" if isinstance(state, tuple) else ""
        for path in ("inner", "episodes.inner"):  # of `AutoReset` and `VectorEnvironment`
            with contextlib.suppress(AttributeError):
                if isinstance(operator.attrgetter(path)(state), State):
                    hint = f"; take its `{path}`"
        raise ValueError(f"expected a trap_tube_jax.State, got {type(state).__name__}{hint}")


def check_state(state: Any) -> None:
    """Checks that `state` is one unbatched `State` with fields of the right shape and dtype.

    Args:
      state: arrays or tracers in the fields.

    Raises:
      ValueError: naming the field, what it is and what it must be.
    """
    check_is_state(state)
    for name, (shape, dtype) in _FIELDS.items():
        field = getattr(state, name)
        if not hasattr(field, "shape") or not hasattr(field, "dtype"):
            raise ValueError(f"state.{name} must be an array, got {type(field).__name__}")
        if field.dtype != dtype or not _fits(field.shape, shape):
            extra = len(field.shape) - len(shape)
            is_batch = extra > 0 and _fits(field.shape[extra:], shape)
            raise ValueError(
                f"state.{name} must be {np.dtype(dtype).name}{_written(shape)}, got "
                + describe_array(field)
                + (f"; {BATCH_HINT}" if is_batch else "")
            )


def with_narrow_integers(state: Any) -> Any:
    """Cuts 64-bit integers, which arithmetic gives under `jax_enable_x64`, to 32 bits."""

    def narrow(field: Any) -> Any:
        return field.astype(np.int32) if getattr(field, "dtype", None) == np.int64 else field

    return jax.tree.map(narrow, state)


def _fits(found: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    pairs = zip(found, shape, strict=False)
    return len(found) == len(shape) and all(a == b if b else a >= 1 for a, b in pairs)


def _written(shape: tuple[int | None, ...]) -> str:
    return f"[{', '.join(str(size or 'N') for size in shape)}]"


def _convert(name: str, value: Any) -> np.ndarray:
    """Converts `value` to the shape and dtype of a field."""
    array = np.asarray(integer_array(name, value))
    shape, dtype = _FIELDS[name]
    if not _fits(array.shape, shape):
        raise ValueError(f"{name} must be integer{_written(shape)}, got {describe_array(array)}")
    limits = np.iinfo(dtype)
    outside = array[(array < limits.min) | (array > limits.max)]
    if outside.size:
        raise ValueError(f"{name} holds {outside[0]}; allowed: {limits.min} to {limits.max}")
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
    if not isinstance(rows, Sequence) or len(rows) != BOARD_SIZE:
        found = f"{len(rows)} rows" if isinstance(rows, Sequence) else type(rows).__name__
        raise ValueError(f"the picture must have {BOARD_SIZE} rows, got {found}")
    for index, line in enumerate(rows):
        if not isinstance(line, str) or len(line) != BOARD_SIZE:
            raise ValueError(f"row {index} must have {BOARD_SIZE} characters, got {line!r}")
        for column, char in enumerate(line):
            if char not in OBJECT_CHARS:
                known = zip(OBJECT_CHARS, OBJECT_NAMES, strict=True)
                raise ValueError(
                    f"row {index}, column {column}: unknown character {char!r}; allowed: "
                    + ", ".join(f"{char!r} {name}" for char, name in known)
                )
    return np.array([[OBJECT_CHARS.index(char) for char in line] for line in rows], np.uint8)


def _place(codes: np.ndarray, code: int, given: Any, longest: int = 1) -> tuple[Any, Any]:
    """Returns top-left cell and extent of the bar drawn as `code`, or the cell `given`."""
    cells = np.argwhere(codes == code)
    name = OBJECT_NAMES[code]
    drawn = [tuple(cell) for cell in cells.tolist()]
    if given is not None:
        if drawn:
            raise ValueError(
                f"{name} is given as {given} and drawn at {drawn}; allowed: one of the two"
            )
        return given, None
    extent = np.ptp(cells, axis=0) + 1 if drawn else None
    if extent is None or sorted(extent) != [1, len(drawn)] or len(drawn) > longest:
        shape = f"one straight bar of 1 to {longest} cells" if longest > 1 else "exactly one cell"
        keywords = f"{name}= and {name}_extent=" if longest > 1 else f"{name}="
        raise ValueError(
            f"the {name} {OBJECT_CHARS[code]!r} must be drawn as {shape}, got {len(drawn)}: "
            f"{drawn}; or not drawn and given by {keywords}"
        )
    return cells[0], extent
