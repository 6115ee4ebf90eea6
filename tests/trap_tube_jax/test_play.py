"""Playing by hand: keys, hints and the screen, most of it without a terminal."""

import dataclasses
import functools
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios

import jax
import jax.numpy as jnp
import pytest

import trap_tube_jax as tt
from helpers.refusal import refused
from trap_tube_jax import play
from trap_tube_jax.interruptions import SIGNALS

UP = "\x1b[A"
LEFT = "\x1b[D"
RIGHT = "\x1bOC"


def press_all(game, keys):
    return functools.reduce(play.press, keys, game)


def having(game, **fields):
    """The game in a state with other fields."""
    return dataclasses.replace(game, state=game.state.replace(**fields))


@pytest.fixture(scope="module")
def game():
    return play.new_game("base", 0)


def test_a_new_game_is_the_environments_task(game):
    assert (game.name, game.seed, game.state) == ("TrapTube-v0", 0, tt.base_state())
    expected, _ = jax.jit(tt.make("st").reset)(jax.random.key(4))
    assert play.new_game("st", 4).state == expected
    with pytest.raises(ValueError, match="seed must be an integer >= 0 and <= 4294967295, got -1"):
        play.new_game("base", -1)


@pytest.mark.parametrize(
    ("key", "move"), [("k", 0), ("j", 1), ("h", 2), ("l", 3), (UP, 0), (RIGHT, 3)]
)
@pytest.mark.parametrize(("hand", "grasp"), [("w", 0), ("s", 1), ("a", 2), ("d", 3)])
def test_keys_turn_the_hand_and_move(game, key, move, hand, grasp):
    turned = play.press(game, hand)
    assert (turned.grasp, int(turned.state.time)) == (grasp, 0)
    expected, _ = play._step(tt.Environment(), game.state, jnp.array([grasp, move], jnp.int32))
    after = play.press(turned, key)
    assert (after.grasp, after.state) == (grasp, expected)


def test_keys_restart_and_draw_the_next_task(game):
    restarted = press_all(game, [UP, "d", "r"])
    assert (restarted.seed, restarted.state) == (0, game.state)
    assert play.press(game, "n").seed == 1
    assert play.press(dataclasses.replace(game, seed=2**32 - 1), "n").seed == 0
    assert play.press(game, "\x1b[18~") is game


def test_hints_lead_to_the_food(game):
    plan = tt.solve(game.state)
    for step, (grasp, move) in enumerate(plan.actions.tolist()):
        game = play.press(game, "?")
        names = ("up", "down", "left", "right")
        assert (
            game.message == f"hint: hand {names[grasp]}, move {names[move]}, and {10 - step} more"
        )
        game = press_all(game, ["wsad"[grasp], "kjhl"[move]])
    assert game.message.startswith("solved in 11 steps!")
    for key in (UP, "?"):
        assert play.press(game, key) == game


def test_the_limit_ends_the_episode(game):
    game = press_all(game, [LEFT] * 50)
    assert "step 50 of 50" in drawn(game)[1]
    assert game.message.startswith("out of steps")
    for key in (LEFT, "?"):
        assert play.press(game, key) == game


def test_a_hint_says_if_nothing_helps(game):
    board = game.state.board
    walls = board.at[8:11, 0].set(3).at[8, 1].set(3).at[10, 1].set(3).at[8:11, 2].set(3)
    assert "out of reach" in play.press(having(game, board=walls), "?").message


def drawn(game):
    """The screen as lines of text without colours."""
    return re.sub(r"\x1b\[[\d;]*m", "", play.screen(game)).splitlines()


def test_the_screen_shows_the_board_and_fits(game):
    lines = drawn(game)
    assert len(lines) < 24
    assert max(map(len, lines)) < 80
    assert lines[0] == "TrapTube-v0   seed 0"
    assert lines[6][:26] == "|  ||    ////////        |"
    assert lines[7][:26] == "|  ||    ><@@  ()        |"
    assert lines[11][:26] == "|  /\\                    |"
    assert "step 0 of 50" in lines[1]
    assert "hand up: empty" in lines[2]
    assert "goal: move onto the food @@" in lines[3]
    assert sum("@@ food" in line for line in lines) == 1


def test_the_screen_shows_the_hand_and_a_horizontal_tool(game):
    holding = press_all(game, [UP])
    assert "hand up: holds the tool" in drawn(holding)[2]
    turned = play.press(holding, "d")
    assert "hand right: empty" in drawn(turned)[2]
    assert drawn(turned)[10][:26] == "|  ->                    |"
    assert sum("-> agent" in line for line in drawn(turned)) == 1
    tool = jnp.array([0, 0], jnp.int32)
    extent = game.state.tool_extent[::-1]
    lying = drawn(having(game, tool=tool, tool_extent=extent))
    assert lying[2][:11] == "|========  "
    assert sum("== tool" in line for line in lying) == 1


@pytest.mark.parametrize(
    ("palette", "style"),
    [
        ([(0, 0, 0)] * 8, "1;38;5;231;48;5;16"),
        ([(255, 250, 250)] * 8, "1;38;5;16;48;5;231"),
        ([(255, 0, 60)] * 8, "1;38;5;231;48;5;197"),
        ([(255, 0)] * 8, "1;38;5;231;48;5;196"),
        ([(102,)] * 8, "1;38;5;231;48;5;59"),
    ],
)
def test_colors_are_the_nearest_of_the_terminals(game, palette, style):
    shown = play.screen(having(game, palette=jnp.array(palette, jnp.uint8)))
    assert f"\x1b[{style}m@@\x1b[0m" in shown


def test_without_a_terminal_the_command_line_says_so(monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    assert "play needs a terminal" in refused(capsys, play.main)
    assert "unknown task set 'x'" in refused(capsys, play.main, "x")
    monkeypatch.setattr("sys.stdin", None)
    assert "play needs a terminal" in refused(capsys, play.main)
    monkeypatch.setitem(sys.modules, "termios", None)
    with pytest.raises(ValueError, match="a Unix terminal"), play._single_keys(0):
        pass


def read_until(terminal, text):
    """Reads the terminal up to and including `text`."""
    shown = ""
    while text not in shown:
        ready, _, _ = select.select([terminal], [], [], 120)
        assert ready, f"nothing more after {shown!r}"
        shown += os.read(terminal, 65536).decode()
    return shown


# Plays as the child of a shell, and prints whether the terminal's modes were restored.
SHELL = """
import os, signal, subprocess, sys, termios
os.login_tty(0)
before = termios.tcgetattr(0)
game = subprocess.Popen([sys.executable, "-m", "trap_tube_jax.play"])
signal.signal(signal.SIGUSR2, lambda *_: game.send_signal(int(sys.argv[1])))
print("code", game.wait(), "restored", termios.tcgetattr(0) == before, "end")
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_a_game_and_leaves_the_terminal_as_before(number):
    ours, theirs = pty.openpty()
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
    process = subprocess.Popen([sys.executable, "-c", SHELL, str(number)], **streams)
    os.close(theirs)
    try:
        read_until(ours, "quit")
        assert not termios.tcgetattr(ours)[3] & termios.ECHO, "keys are unseen"
        process.send_signal(signal.SIGUSR2)
        shown = read_until(ours, "end")
        assert "Stopped. The same command starts again.\r\n" in shown
        assert f"code {128 + number} restored True" in shown
    finally:
        process.kill()
        process.wait()
        os.close(ours)


def test_a_game_starts_and_quits_in_a_real_terminal():
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "trap_tube_jax.play", "base"],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=os.environ | {"TERM": "xterm-256color", "LINES": "24", "COLUMNS": "80"},
    )
    os.close(theirs)
    try:
        screen = read_until(ours, "quit")
        assert "TrapTube-v0   seed 0" in screen
        assert "\x1b[" in screen
        os.write(ours, b"k?")  # keys typed ahead are read one by one
        assert "thinking" in read_until(ours, "hint: hand")
        os.write(ours, b"dq")
        assert process.wait(timeout=120) == 0
    finally:
        process.kill()
        os.close(ours)
