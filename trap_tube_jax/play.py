"""Play by hand in a terminal: `python -m trap_tube_jax.play PerceptualTrapTube-v0 --seed 3`.

`press` maps a game and a key to the next game, and `screen` turns a game into coloured text.
Only `_run` and `_draw` use the terminal.
"""

import argparse
import contextlib
import dataclasses
import functools
import sys
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from trap_tube_jax.checks import LARGEST_SEED, check_seed
from trap_tube_jax.command_line import add_import_option, plain_errors
from trap_tube_jax.dynamics import holds_tool
from trap_tube_jax.environment import Environment
from trap_tube_jax.imports import import_modules
from trap_tube_jax.objects import (
    AGENT,
    BOARD_SIZE,
    DIRECTION_NAMES,
    LUMA,
    NUM_OBJECTS,
    OBJECT_NAMES,
    TOOL,
)
from trap_tube_jax.observation import visible_objects
from trap_tube_jax.registry import make, task_set
from trap_tube_jax.rendering import rgb
from trap_tube_jax.solver import solve
from trap_tube_jax.state import State

Color = tuple[int, ...]  # red, green, blue
Piece = tuple[str, Color | None]  # text and its background, or None for the terminal's own

WIDTH = 66  # of the screen, in characters
SIGNS = ["  ", "><", "()", "//", "\\\\", "@@", "||", "/\\"]  # by object code
HORIZONTAL_TOOL = "=="
AGENT_SIGNS = ("/\\", "\\/", "<-", "->")  # by grasp direction

MOVE_KEYS = {"KEY_UP": 0, "KEY_DOWN": 1, "KEY_LEFT": 2, "KEY_RIGHT": 3} | {
    key: direction for direction, key in enumerate("kjhl")
}
GRASP_KEYS = {key: direction for direction, key in enumerate("wsad")}
NEXT_TASK_KEYS = {"r": 0, "n": 1}  # by how much the seed grows
HINT_KEY = "?"
HELP = (
    ("arrows, hjkl", "move"),
    ("w a s d", "turn the hand"),
    ("?", "hint: the next action"),
    ("r", "restart"),
    ("n", "next task"),
    ("q", "quit"),
)

_reset = jax.jit(Environment.reset, static_argnums=0)
_step = jax.jit(Environment.step, static_argnums=0)


@dataclasses.dataclass(frozen=True)
class Game:
    """A task in play.

    Attributes:
      env: the environment.
      name: the task set's id.
      seed: the seed of the task.
      state: the present state.
      grasp: the direction of the hand, held until changed.
      message: the line below the board.
    """

    env: Environment
    name: str
    seed: int
    state: State
    grasp: int = 0
    message: str = ""


def new_game(name: str, seed: int) -> Game:
    """Starts the task that `make(name).reset(jax.random.key(seed))` draws.

    Raises:
      ValueError: the task set is unknown, or `seed` is not an integer from 0 to 2**32 - 1.
    """
    entry = task_set(name)
    return _deal(make(entry.id), entry.id, check_seed(seed))


def press(game: Game, key: str) -> Game:
    """Returns the game after a key; keys without a meaning change nothing.

    Args:
      game: the game.
      key: its name in curses, such as "KEY_UP" or "w".
    """
    if key in GRASP_KEYS:
        return dataclasses.replace(game, grasp=GRASP_KEYS[key], message="")
    if key in NEXT_TASK_KEYS:
        seed = (game.seed + NEXT_TASK_KEYS[key]) % (LARGEST_SEED + 1)
        return _deal(game.env, game.name, seed)
    if key not in MOVE_KEYS and key != HINT_KEY:
        return game
    state = game.state
    if state.terminated | state.truncated:
        message = "the episode is over: r restart, n next task"
    elif key == HINT_KEY:
        message = _hint(state)
    else:
        state, _ = _step(game.env, state, np.array([game.grasp, MOVE_KEYS[key]], np.int32))
        message = _outcome(state)
    return dataclasses.replace(game, state=state, message=message)


def screen(game: Game) -> list[list[Piece]]:
    """Returns the lines of the screen: the board next to the keys and signs, and a message."""
    holds = "holds the tool" if holds_tool(game.state, game.grasp) else "empty"
    signs = [f"{SIGNS[code]} {OBJECT_NAMES[code]:<9}" for code in range(NUM_OBJECTS)]
    panel = (
        f"step {game.state.time}",
        f"hand {DIRECTION_NAMES[game.grasp]}: {holds}",
        "",
        *(f"{keys:<14}{meaning}" for keys, meaning in HELP),
        "",
        *map("".join, zip(signs[:4], signs[4:], strict=True)),
    )
    return [
        [(f"{game.name}   seed {game.seed}", None)],
        *([*row, (f"   {text}", None)] for row, text in zip(_board(game), panel, strict=True)),
        [(game.message, None)],
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` are those of the process if absent."""
    parser = argparse.ArgumentParser(
        prog="python -m trap_tube_jax.play", description="Play a task set in the terminal."
    )
    parser.add_argument(
        "task_set",
        nargs="?",
        default="TrapTube-v0",
        help="id such as PerceptualTrapTube-v0, or short name such as p",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="first task, 0 to 2**32 - 1; the next ones follow it"
    )
    add_import_option(parser)
    options = parser.parse_args(arguments)
    with plain_errors():
        import_modules(options.imports)
        _play(new_game(options.task_set, options.seed))


def _deal(env: Environment, name: str, seed: int) -> Game:
    state, _ = _reset(env, jax.random.key(seed))
    return Game(env, name, seed, state)


def _hint(state: State) -> str:
    plan = solve(state)
    if not plan.solvable:
        return "the food is out of reach for good: r restart, n next task"
    grasp, move = (DIRECTION_NAMES[direction] for direction in plan.actions[0])
    return f"hint: hand {grasp}, move {move}, and {plan.length - 1} more"


def _outcome(state: State) -> str:
    if state.terminated:
        return f"solved in {state.time} steps!  n: next task"
    return f"not solved in {state.time} steps.  r: restart" if state.truncated else ""


def _board(game: Game) -> list[list[Piece]]:
    """Draws the board, two characters a cell, inside a frame."""
    colors = list(map(tuple, np.asarray(rgb(game.state.palette)).tolist()))
    signs = SIGNS.copy()
    signs[AGENT] = AGENT_SIGNS[game.grasp]
    if game.state.tool_extent[1] > 1:
        signs[TOOL] = HORIZONTAL_TOOL
    edge: list[Piece] = [("+" + "--" * BOARD_SIZE + "+", None)]
    rows = np.asarray(visible_objects(game.state)).tolist()
    cells = [[(signs[code], colors[code]) for code in row] for row in rows]
    return [edge, *([("|", None), *row, ("|", None)] for row in cells), edge]


def _play(game: Game) -> None:
    """Plays, or raises ValueError where there is no terminal to play in."""
    try:
        import curses  # noqa: PLC0415 - absent on Windows
    except ImportError:
        raise ValueError("needs the module curses: pip install windows-curses") from None
    try:
        if not (sys.stdin.isatty() and sys.stdout.isatty()):
            raise curses.error("its input or output is not a terminal")
        curses.setupterm()
        if not curses.tigetstr("cup"):
            raise curses.error("the terminal cannot place its cursor")
        curses.wrapper(_run, game)
    except curses.error as error:
        raise ValueError(f"play needs a terminal: {error}") from None


def _run(window: Any, game: Game) -> None:
    """Draws and reads keys until the player quits."""
    import curses  # noqa: PLC0415 - absent on Windows

    if curses.has_colors():
        curses.use_default_colors()
    with contextlib.suppress(curses.error):  # a terminal that cannot hide its cursor
        curses.curs_set(0)
    key = ""
    while key != "q":
        _draw(window, game)
        try:
            key = window.getkey()
        except (KeyboardInterrupt, curses.error):
            return
        if key == HINT_KEY:  # the search takes a moment
            _draw(window, dataclasses.replace(game, message="thinking ..."))
        game = press(game, key)


def _draw(window: Any, game: Game) -> None:
    """Draws the screen, or the size that it needs."""
    height, width = window.getmaxyx()
    lines = screen(game)
    if height < len(lines) or width < WIDTH:
        text = f"{width} x {height} is too small: play needs {WIDTH} x {len(lines)}"
        lines = [[(text[: max(width - 1, 0)], None)]]
    window.erase()
    for row, line in enumerate(lines):
        window.move(row, 0)
        for text, color in line:
            window.addstr(text, 0 if color is None else _attribute(color))
    window.refresh()


@functools.cache
def _attribute(color: Color) -> int:
    """Returns curses' attribute for black or white on a colour; 0 where there are too few."""
    import curses  # noqa: PLC0415 - absent on Windows

    if not curses.has_colors() or curses.COLORS < 256:
        return 0
    # Of xterm's colours 16 to 231, a 6 x 6 x 6 cube. Each is the number of a pair too, since some
    # terminals have no more than 256 pairs.
    background = 16 + int(np.rint(np.array(color) / 51) @ (36, 6, 1))
    is_dark = np.dot(color, LUMA) < 128
    curses.init_pair(background, 231 if is_dark else 16, background)
    return curses.color_pair(background) | curses.A_BOLD


if __name__ == "__main__":
    main()
