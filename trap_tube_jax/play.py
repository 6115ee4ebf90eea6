"""Playing by hand in a terminal: `python -m trap_tube_jax.play PerceptualTrapTube-v0 --seed 3`.

The game is pure: `press` maps a game and a key to the next game, and `screen` turns a game
into coloured text. Only `_run` and what it calls know the terminal.
"""

import contextlib
import dataclasses
import functools
import os
import pathlib
import sys
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tyro

from trap_tube_jax.checks import LARGEST_SEED, check_seed
from trap_tube_jax.command_line import Imports, plain_errors
from trap_tube_jax.dynamics import holds_tool
from trap_tube_jax.imports import import_modules
from trap_tube_jax.objects import (
    AGENT,
    BASE_COLORS,
    BOARD_SIZE,
    DIRECTION_NAMES,
    LUMA,
    NUM_OBJECTS,
    OBJECT_NAMES,
    TOOL,
)
from trap_tube_jax.observation import visible_objects
from trap_tube_jax.registry import make, task_set
from trap_tube_jax.rendering import episode_frames, rgb, save_gif
from trap_tube_jax.solver import solve
from trap_tube_jax.state import State

HEIGHT, WIDTH = 21, 76  # of the screen, in characters
PANEL = 30  # column at which the text beside the board starts
SIGNS: tuple[str, ...] = (
    "  ",
    "><",
    "()",
    "//",
    "\\\\",
    "@@",
    "||",
    "/\\",
)  # two characters per object code
HORIZONTAL_TOOL = "=="
AGENT_SIGNS = ("/\\", "\\/", "<-", "->")  # by grasp direction

MOVE_KEYS = {"KEY_UP": 0, "KEY_DOWN": 1, "KEY_LEFT": 2, "KEY_RIGHT": 3} | {
    key: direction for direction, key in enumerate("kjhl")
}
GRASP_KEYS = {key: direction for direction, key in enumerate("wsad")}
HELP = (
    ("arrows, hjkl", "move"),
    ("w a s d", "turn the hand"),
    ("?", "hint: the next action"),
    ("enter", "take the hint"),
    ("u", "undo"),
    ("r", "restart"),
    ("n", "next task"),
    ("g", "save a GIF"),
    ("z", "save an .npz"),
    ("q", "quit"),
)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Plays a task set in the terminal.

    Attributes:
      task_set: an id such as PerceptualTrapTube-v0, or a short name such as p.
      seed: the first task, 0 to 2**32 - 1; the next ones follow it.
      out: the folder for recordings.
      imports: modules of your own to import first, for the sets that they register.
    """

    task_set: Annotated[str, tyro.conf.Positional] = "TrapTube-v0"
    seed: int = 0
    out: pathlib.Path = pathlib.Path(".")
    imports: Imports = ()


@dataclasses.dataclass(frozen=True)
class Game:
    """An episode so far.

    Attributes:
      task_set: the task set's id.
      seed: the seed of the task.
      states: the states so far, the present one last.
      actions: the (grasp, move) between them.
      grasp: the direction of the hand, held until changed.
      hint: the (grasp, move) that a shortest solution takes next, if asked for.
      message: the line below the board.
    """

    task_set: str
    seed: int
    states: tuple[State, ...]
    actions: tuple[tuple[int, int], ...] = ()
    grasp: int = 0
    hint: tuple[int, int] | None = None
    message: str = ""

    @property
    def state(self) -> State:
        """The present state."""
        return self.states[-1]

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return bool(self.state.terminated | self.state.truncated)


class Span(NamedTuple):
    """Text on the screen.

    Attributes:
      row: its line, 0 at the top.
      column: that of its first character.
      text: what it says.
      color: RGB of the background, or None for the terminal's own.
    """

    row: int
    column: int
    text: str
    color: tuple[int, int, int] | None = None


def new_game(name: str, seed: int) -> Game:
    """The task that `make(name).reset(jax.random.key(seed))` draws.

    Raises:
      ValueError: there is no such task set, or `seed` is not an integer from 0 to 2**32 - 1.
    """
    entry, seed = task_set(name), check_seed(seed)
    state = _draw_task(entry.id)(jax.random.key(seed))
    return Game(entry.id, seed, (state,))


def press(game: Game, key: str) -> Game:
    """The game after a key; keys without a meaning change nothing.

    Args:
      game: the game.
      key: its name as curses gives it, such as "KEY_UP", "w" or a newline.
    """
    game = _say(game, "")
    if key in GRASP_KEYS:
        return dataclasses.replace(game, grasp=GRASP_KEYS[key], hint=None)
    if key in MOVE_KEYS:
        return _act(game, (game.grasp, MOVE_KEYS[key]))
    return COMMANDS[key](game) if key in COMMANDS else game


def save(game: Game, path: str | os.PathLike[str]) -> None:
    """Records the episode so far.

    An `.npz` holds task_set, seed, actions i32[T, 2], rewards f32[T], and every field of
    `State` stacked over the T + 1 states; a `.gif` the pictures.

    Args:
      game: the game.
      path: the file to write.

    Raises:
      ValueError: the path ends neither in .npz nor in .gif.
    """
    suffix = pathlib.Path(path).suffix
    actions = np.array(game.actions, np.int32).reshape(-1, 2)
    if suffix == ".gif":
        save_gif(episode_frames(game.states[0], actions), path, fps=4)
    elif suffix == ".npz":
        fields: dict[str, Any] = {
            field.name: np.stack([getattr(state, field.name) for state in game.states])
            for field in dataclasses.fields(State)
        }
        fields |= {"actions": actions, "rewards": fields["terminated"][1:].astype(np.float32)}
        np.savez_compressed(path, task_set=game.task_set, seed=game.seed, **fields)
    else:
        raise ValueError(f"a recording ends in .gif or .npz, got {os.fspath(path)!r}")


def screen(game: Game) -> list[Span]:
    """What the player sees: the board, the signs' meaning, the keys, the message."""
    return [
        Span(0, 1, f"{game.task_set}   seed {game.seed}"),
        *_board(game),
        *_legend(),
        *_panel(game),
        Span(HEIGHT - 1, 1, game.message),
    ]


def terminal_color(rgb: tuple[int, int, int]) -> int:
    """The nearest of xterm's colours 16 to 255: a 6 x 6 x 6 cube and 24 greys."""
    levels = np.array([0, 95, 135, 175, 215, 255])
    cube = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), -1).reshape(-1, 3)
    greys = np.repeat(8 + 10 * np.arange(24), 3).reshape(-1, 3)
    distance = np.sum((np.concatenate([cube, greys]) - np.array(rgb)) ** 2, axis=-1)
    return 16 + int(np.argmin(distance))


def main(arguments: Arguments) -> None:
    """Plays, or says why that cannot be.

    Raises:
      ValueError: the task set is unknown, or there is no terminal to play in.
    """
    import_modules(arguments.imports)
    task_set(arguments.task_set)
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ValueError(
            "needs a terminal, but its input or output is not one; "
            "`python -m trap_tube_jax.gallery` draws pictures without one"
        )
    try:
        import curses  # noqa: PLC0415 - absent on Windows
    except ImportError:
        raise ValueError("needs the module curses: pip install windows-curses") from None
    arguments.out.mkdir(parents=True, exist_ok=True)
    game = new_game(arguments.task_set, arguments.seed)
    try:
        curses.setupterm()
        if not curses.tigetstr("cup"):
            raise curses.error("it cannot place its cursor")
        curses.wrapper(_run, game, arguments.out)
    except curses.error as error:
        terminal = os.environ.get("TERM", "")
        raise ValueError(f"the terminal {terminal!r} cannot be drawn on: {error}") from None


def _act(game: Game, action: tuple[int, int]) -> Game:
    if game.over:
        return _say(game, "the episode is over: u undo, r restart, n next task")
    state = _advance(game.task_set)(game.state, np.array(action, np.int32))
    game = dataclasses.replace(
        game,
        states=(*game.states, state),
        actions=(*game.actions, action),
        grasp=action[0],
        hint=None,
    )
    if state.terminated:
        return _say(game, f"solved in {len(game.actions)} steps!  n: next task, g: save a GIF")
    if state.truncated:
        return _say(game, f"not solved in {len(game.actions)} steps.  u: undo, r: restart")
    return game


def _hint(game: Game) -> Game:
    if game.over:
        return _say(game, "the episode is over: u undo, r restart, n next task")
    plan = solve(game.state)
    if not plan.solvable:
        return _say(game, "the food is out of reach for good: u undo, r restart")
    grasp, move = plan.actions[0].tolist()
    names = f"hand {DIRECTION_NAMES[grasp]}, move {DIRECTION_NAMES[move]}"
    text = f"hint: {names} (enter), and {plan.length - 1} more"
    return dataclasses.replace(_say(game, text), hint=(grasp, move))


def _take_hint(game: Game) -> Game:
    return _act(game, game.hint) if game.hint else _say(game, "ask for a hint first: ?")


def _undo(game: Game) -> Game:
    if not game.actions:
        return _say(game, "nothing to undo")
    return dataclasses.replace(
        game,
        states=game.states[:-1],
        actions=game.actions[:-1],
        grasp=game.actions[-1][0],
        hint=None,
    )


def _restart(game: Game) -> Game:
    return Game(game.task_set, game.seed, game.states[:1], message="restarted")


def _next_task(game: Game) -> Game:
    return new_game(game.task_set, (game.seed + 1) % (LARGEST_SEED + 1))


COMMANDS = {"?": _hint, "\n": _take_hint, "u": _undo, "r": _restart, "n": _next_task}


def _say(game: Game, message: str) -> Game:
    return dataclasses.replace(game, message=message)


@functools.cache
def _draw_task(name: str) -> Any:
    env = make(name)
    return jax.jit(lambda key: env.reset(key)[0])


@functools.cache
def _advance(name: str) -> Any:
    env = make(name)
    return jax.jit(lambda state, action: env.step(state, action)[0])


def _board(game: Game) -> list[Span]:
    """The board, two characters a cell, inside a frame."""
    state = jax.tree.map(np.asarray, game.state)
    objects = np.asarray(visible_objects(game.state))
    colors = _colors(rgb(game.state.palette))
    signs = list(SIGNS)
    signs[AGENT] = AGENT_SIGNS[game.grasp]
    if state.tool_extent[1] > 1:
        signs[TOOL] = HORIZONTAL_TOOL
    edge = "+" + "-" * 2 * BOARD_SIZE + "+"
    spans = [Span(1, 1, edge), Span(2 + BOARD_SIZE, 1, edge)]
    for row in range(BOARD_SIZE):
        spans += [Span(2 + row, 1, "|"), Span(2 + row, 2 + 2 * BOARD_SIZE, "|")]
        spans += [
            Span(2 + row, 2 + 2 * column, signs[code], colors[code])
            for column, code in enumerate(objects[row])
        ]
    return spans


def _colors(palette: Any) -> list[tuple[int, int, int]]:
    """Of every object, RGB u8[8, 3] as plain numbers."""
    return [(red, green, blue) for red, green, blue in np.asarray(palette).tolist()]


def _legend() -> list[Span]:
    """The signs with their objects' base colours, in two lines of four."""
    spans, colors = [], _colors(BASE_COLORS)
    for code in range(NUM_OBJECTS):
        row, column = divmod(code, 4)
        spans += [
            Span(16 + row, 1 + 12 * column, SIGNS[code], colors[code]),
            Span(16 + row, 4 + 12 * column, OBJECT_NAMES[code]),
        ]
    return spans


def _panel(game: Game) -> list[Span]:
    """What is going on, and the keys."""
    holds = "holds the tool" if holds_tool(game.state, game.grasp) else "empty"
    lines = [
        f"step {len(game.actions)}",
        f"hand {DIRECTION_NAMES[game.grasp]}: {holds}",
        "",
        *(f"{keys:<14}{meaning}" for keys, meaning in HELP),
    ]
    return [Span(2 + index, PANEL, line) for index, line in enumerate(lines)]


def _run(window: Any, game: Game, folder: pathlib.Path) -> None:
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
        if key in ("?", "n"):  # these take a moment
            _draw(window, _say(game, "thinking ..."))
        if key in ("g", "z"):
            path = folder / f"{game.task_set}-seed{game.seed}{'.gif' if key == 'g' else '.npz'}"
            try:
                save(game, path)
            except OSError as error:
                game = _say(game, f"not saved: {error}")
            else:
                game = _say(game, f"saved {path}")
        else:
            game = press(game, key)


def _draw(window: Any, game: Game) -> None:
    """Draws the screen, or how large the terminal would have to be."""
    height, width = window.getmaxyx()
    window.erase()
    if height < HEIGHT or width < WIDTH:
        text = f"{width} x {height} is too small: play needs {WIDTH} x {HEIGHT}"
        window.addnstr(0, 0, text, max(width - 1, 0))
    else:
        for span in screen(game):
            attribute = 0 if span.color is None else _attribute(span.color)
            window.addnstr(span.row, span.column, span.text, width - 1 - span.column, attribute)
    window.refresh()


@functools.cache
def _attribute(color: tuple[int, int, int]) -> int:
    """The curses attribute for black or white on a colour; none where there are too few."""
    import curses  # noqa: PLC0415 - absent on Windows

    if not curses.has_colors() or curses.COLORS < 256:
        return 0
    background = terminal_color(color)
    is_dark = np.dot(color, LUMA) < 128
    # One pair per background, named like it: 256 pairs is all that some terminals have.
    curses.init_pair(background, 231 if is_dark else 16, background)
    return curses.color_pair(background) | curses.A_BOLD


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Arguments))
