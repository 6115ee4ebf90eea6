"""Play by hand in a terminal: `python -m trap_tube_jax.play PerceptualTrapTube-v0 --seed 3`.

`press` maps a game and a key to the next game, and `screen` turns a game into coloured text.
"""

import argparse
import contextlib
import dataclasses
import os
import re
import sys
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from trap_tube_jax.checks import MAX_SEED, check_seed
from trap_tube_jax.command_line import add_import_option, plain_errors
from trap_tube_jax.dynamics import holds_tool
from trap_tube_jax.environment import Environment
from trap_tube_jax.imports import import_modules
from trap_tube_jax.interruptions import run_command
from trap_tube_jax.objects import (
    AGENT,
    BOARD_SIZE,
    DIRECTION_NAMES,
    FOOD,
    LUMA,
    OBJECT_NAMES,
    TOOL,
)
from trap_tube_jax.observation import visible_objects
from trap_tube_jax.registry import make, task_set
from trap_tube_jax.rendering import rgb
from trap_tube_jax.solver import solve
from trap_tube_jax.state import State

SIGNS: tuple[str, ...] = ("  ", "><", "()", "//", "\\\\", "@@", "||", "/\\")  # by object code
HORIZONTAL_TOOL = "=="
AGENT_SIGNS = ("/\\", "\\/", "<-", "->")  # by grasp direction

CLEAR_SCREEN = "\x1b[2J\x1b[H"
KEYS = re.compile(r"\x1b[\[O].|.", re.DOTALL)  # an arrow sends three characters
ARROWS = {f"\x1b{mode}{code}": index for mode in "[O" for index, code in enumerate("ABDC")}
MOVE_KEYS = ARROWS | {key: direction for direction, key in enumerate("kjhl")}
GRASP_KEYS = {key: direction for direction, key in enumerate("wsad")}
NEXT_TASK_KEYS = {"r": 0, "n": 1}  # added to the seed
HINT_KEY = "?"
XTERM_LEVELS = np.array([0, 95, 135, 175, 215, 255])  # of red, green and blue
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
      state: the current state.
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
      key: the characters that the terminal sends for it.
    """
    if key in GRASP_KEYS:
        return dataclasses.replace(game, grasp=GRASP_KEYS[key], message="")
    if key in NEXT_TASK_KEYS:
        seed = (game.seed + NEXT_TASK_KEYS[key]) % (MAX_SEED + 1)
        return _deal(game.env, game.name, seed)
    if key not in MOVE_KEYS and key != HINT_KEY:
        return game
    state = game.state
    if state.done:
        message = _outcome(state)
    elif key == HINT_KEY:
        message = _hint(state)
    else:
        state, _ = _step(game.env, state, np.array([game.grasp, MOVE_KEYS[key]], np.int32))
        message = _outcome(state)
    return dataclasses.replace(game, state=state, message=message)


def screen(game: Game) -> str:
    """Returns the board next to the keys and signs, and the message, as coloured text."""
    holds = "holds the tool" if holds_tool(game.state, game.grasp) else "empty"
    signs = [f"{sign} {name:<9}" for sign, name in zip(_signs(game), OBJECT_NAMES, strict=True)]
    panel = (
        f"step {game.state.time} of {game.env.max_steps}",
        f"hand {DIRECTION_NAMES[game.grasp]}: {holds}",
        f"goal: move onto the food {SIGNS[FOOD]}",
        *(f"{keys:<14}{meaning}" for keys, meaning in HELP),
        "",
        *map("".join, zip(signs[:4], signs[4:], strict=True)),
    )
    lines = (f"{row}   {text}" for row, text in zip(_board(game), panel, strict=True))
    return "\n".join([f"{game.name}   seed {game.seed}", *lines, game.message])


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; `arguments` defaults to `sys.argv[1:]`."""
    parser = argparse.ArgumentParser(
        prog="python -m trap_tube_jax.play", description="Plays a task set in the terminal."
    )
    parser.add_argument(
        "task_set",
        nargs="?",
        default="TrapTube-v0",
        help="id such as PerceptualTrapTube-v0, or short name such as p [%(default)s]",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of the first task, 0 to 2**32 - 1; later tasks count up from it [%(default)s]",
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
        return "the food is out of reach for good  r: restart, n: next task"
    grasp, move = (DIRECTION_NAMES[direction] for direction in plan.actions[0])
    return f"hint: hand {grasp}, move {move}, and {plan.length - 1} more"


def _outcome(state: State) -> str:
    if state.terminated:
        return f"solved in {state.time} steps!  r: restart, n: next task"
    return "out of steps  r: restart, n: next task" if state.truncated else ""


def _signs(game: Game) -> list[str]:
    """Returns two characters per object: the agent's show its hand, the tool's its direction."""
    signs = list(SIGNS)
    signs[AGENT] = AGENT_SIGNS[game.grasp]
    if game.state.tool_extent[1] > 1:
        signs[TOOL] = HORIZONTAL_TOOL
    return signs


def _board(game: Game) -> list[str]:
    """Draws the board, two characters a cell, inside a border."""
    colors = np.asarray(rgb(game.state.palette)).tolist()
    cells = [_colored(sign, color) for sign, color in zip(_signs(game), colors, strict=True)]
    edge = "+" + "--" * BOARD_SIZE + "+"
    rows = np.asarray(visible_objects(game.state)).tolist()
    return [edge, *(f"|{''.join(cells[code] for code in row)}|" for row in rows), edge]


def _colored(text: str, color: Sequence[int]) -> str:
    """Writes black or white on the nearest of xterm's 6 x 6 x 6 colours, 16 to 231."""
    nearest = np.abs(np.subtract.outer(color, XTERM_LEVELS)).argmin(axis=-1)
    background = 16 + int(nearest @ (36, 6, 1))
    ink = 231 if np.dot(color, LUMA) < 128 else 16
    return f"\x1b[1;38;5;{ink};48;5;{background}m{text}\x1b[0m"


def _play(game: Game) -> None:
    """Draws and reads keys until the player quits; raises ValueError without a terminal."""
    if not all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stdout)):
        raise ValueError("play needs a terminal; its input or output is not one")
    with _single_keys(sys.stdin.fileno()) as terminal:
        while True:
            print(CLEAR_SCREEN + screen(game), flush=True)
            typed = os.read(terminal, 4096).decode(errors="replace")
            for key in KEYS.findall(typed) or ["q"]:  # a closed terminal reads as nothing
                if key == "q":
                    return
                if key == HINT_KEY:
                    print("thinking ...", flush=True)  # the search takes a moment
                game = press(game, key)


@contextlib.contextmanager
def _single_keys(terminal: int) -> Iterator[int]:
    """Lets a terminal send keys at once and unseen, inside the `with` block."""
    try:
        import termios  # noqa: PLC0415
        import tty  # noqa: PLC0415
    except ImportError:  # Windows
        raise ValueError("play needs a Unix terminal, for example of WSL") from None

    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield terminal
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


if __name__ == "__main__":
    run_command(main)
