"""Playing by hand: keys, hints, recordings and the screen, without a terminal."""

import dataclasses
import functools
import os
import pty
import select
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import trap_tube_jax as tt
from trap_tube_jax import play
from trap_tube_jax.objects import BASE_COLORS

RIGHT = "KEY_RIGHT"
# To the tool's lower end, along with the tool to the right, around the food and into it.
TO_THE_TOOL = ["KEY_UP", *[RIGHT] * 6]


def press_all(game, keys):
    return functools.reduce(play.press, keys, game)


@pytest.fixture(scope="module")
def game():
    return play.new_game("base", 0)


def test_a_new_game_is_the_environments_task(game):
    assert (game.task_set, game.seed, game.actions, game.over) == ("TrapTube-v0", 0, (), False)
    np.testing.assert_array_equal(game.state.board, tt.base_state().board)
    with pytest.raises(ValueError, match="unknown task set 'nonesuch'"):
        play.new_game("nonesuch", 0)
    with pytest.raises(ValueError, match="seed must be an integer >= 0 and <= 4294967295, got -1"):
        play.new_game("base", -1)


@pytest.mark.parametrize(
    ("keys", "move"), [("k", 0), ("j", 1), ("h", 2), ("l", 3), (["KEY_UP"], 0), ([RIGHT], 3)]
)
def test_one_key_moves(game, keys, move):
    after = press_all(game, keys)
    assert after.actions == ((0, move),)
    expected, _ = tt.Environment().step(game.state, jnp.array([0, move]))
    np.testing.assert_array_equal(after.state.agent, expected.agent)


@pytest.mark.parametrize(("key", "grasp"), [("w", 0), ("s", 1), ("a", 2), ("d", 3)])
def test_the_hand_turns_and_stays_turned(game, key, grasp):
    turned = play.press(game, key)
    assert (turned.grasp, turned.actions) == (grasp, ())
    assert press_all(turned, ["KEY_UP", RIGHT]).actions == ((grasp, 0), (grasp, 3))


def test_the_hand_drags_the_tool(game):
    after = press_all(game, TO_THE_TOOL)
    assert after.state.tool.tolist() == [4, 7]
    assert after.state.agent.tolist() == [8, 7]


def test_undo_and_restart(game):
    after = press_all(game, ["KEY_UP", "d", RIGHT])
    undone = play.press(after, "u")
    assert (undone.actions, undone.grasp) == (((0, 0),), 3)
    np.testing.assert_array_equal(undone.state.agent, after.states[1].agent)
    restarted = play.press(after, "r")
    assert restarted.actions == ()
    np.testing.assert_array_equal(restarted.state.agent, game.state.agent)
    assert play.press(game, "u").message == "nothing to undo"


def test_next_task(game):
    assert play.press(press_all(game, "k"), "n").seed == 1
    last = dataclasses.replace(game, seed=2**32 - 1)
    assert play.press(last, "n").seed == 0


def test_unknown_keys_change_nothing(game):
    assert play.press(game, "KEY_F(7)") == game
    assert play.press(game, "\n").message == "ask for a hint first: ?"


def test_hints_lead_to_the_food(game):
    steps = 0
    while not game.over:
        game = play.press(game, "?")
        assert game.message.endswith(f"and {10 - steps} more")
        game = play.press(game, "\n")
        steps += 1
    assert steps == 11
    assert game.message.startswith("solved in 11 steps!")
    for key in ("KEY_UP", "?"):
        assert play.press(game, key).message.startswith("the episode is over")


def test_the_limit_ends_the_episode(game):
    game = press_all(game, ["KEY_LEFT"] * 50)
    assert game.message.startswith("not solved in 50 steps")
    assert len(press_all(game, ["KEY_LEFT"]).actions) == 50


def test_a_hint_where_nothing_helps(game):
    state = game.state
    walls = state.board.at[8:11, 0].set(3).at[8, 1].set(3).at[10, 1].set(3).at[8:11, 2].set(3)
    walled_in = play.Game("TrapTube-v0", 0, (state.replace(board=walls),))
    assert "out of reach" in play.press(walled_in, "?").message


def test_recordings(game, tmp_path):
    game = press_all(game, TO_THE_TOOL)
    play.save(game, tmp_path / "episode.npz")
    with np.load(tmp_path / "episode.npz") as record:
        assert str(record["task_set"]) == "TrapTube-v0"
        assert record["actions"].tolist() == [list(action) for action in game.actions]
        assert record["rewards"].tolist() == [0.0] * 7
        assert record["board"].shape == (8, 12, 12)
        np.testing.assert_array_equal(record["agent"][-1], game.state.agent)
    play.save(game, tmp_path / "episode.gif")
    with Image.open(tmp_path / "episode.gif") as gif:
        assert getattr(gif, "n_frames", 1) == 8
    with pytest.raises(ValueError, match=r"ends in .gif or .npz, got '.*episode.mp4'"):
        play.save(game, tmp_path / "episode.mp4")


def test_a_recording_of_a_solved_episode(game, tmp_path):
    near = game.state.replace(food=game.state.agent.at[1].add(2))
    solved = press_all(dataclasses.replace(game, seed=7, states=(near,)), [RIGHT, RIGHT])
    play.save(solved, tmp_path / "episode.npz")
    with np.load(tmp_path / "episode.npz") as record:
        assert record["seed"] == 7
        assert record["rewards"].tolist() == [0, 1]
        assert record["terminated"].tolist() == [False, False, True]
        assert not record["truncated"].any()
        assert record["time"].tolist() == [0, 1, 2]


def test_what_cannot_be_saved_does_not_end_the_game(game, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(play, "_draw", lambda window, game: shown.append(game.message))
    keys = iter(["z", "q"])
    window = SimpleNamespace(getkey=lambda: next(keys))
    monkeypatch.setattr("curses.has_colors", lambda: False)
    monkeypatch.setattr("curses.curs_set", lambda visible: None)
    play._run(window, game, tmp_path / "missing")
    assert shown[0] == ""
    assert shown[1].startswith("not saved: ")


def drawn(game):
    """The screen as lines of text."""
    lines = np.full((24, 80), " ")
    for span in play.screen(game):
        lines[span.row, span.column : span.column + len(span.text)] = list(span.text)
    return ["".join(line).rstrip() for line in lines]


def test_the_screen_shows_the_board_and_fits(game):
    lines = drawn(game)
    assert all(
        span.row < play.HEIGHT and span.column + len(span.text) <= play.WIDTH
        for span in play.screen(game)
    )
    assert lines[0] == " TrapTube-v0   seed 0"
    assert lines[6][:27] == " |  ||    ////////        |"
    assert lines[7][:27] == " |  ||    ><@@  ()        |"
    assert lines[11][:27] == " |  /\\                    |"
    assert "hand up: empty" in lines[3]


def test_the_screen_shows_the_hand(game):
    holding = press_all(game, ["KEY_UP"])
    assert "hand up: holds the tool" in drawn(holding)[3]
    turned = play.press(holding, "d")
    assert "hand right: empty" in drawn(turned)[3]
    assert drawn(turned)[10][:27] == " |  ->                    |"


def test_the_screen_shows_a_horizontal_tool_in_its_color(game):
    state = game.state
    lying = state.replace(tool=state.tool.at[:].set([0, 0]), tool_extent=state.tool_extent[::-1])
    game = play.Game("TrapTube-v0", 0, (lying,))
    spans = [span for span in play.screen(game) if span.text == "=="]
    assert [(span.row, span.column) for span in spans] == [(2, 2 + 2 * i) for i in range(4)]
    assert {span.color for span in spans} == {tuple(BASE_COLORS[6].tolist())}


@pytest.mark.parametrize("num_features", [1, 2, 5])
def test_the_screen_shows_other_numbers_of_features_as_pictures_do(game, num_features):
    features = np.arange(8 * num_features, dtype=np.uint8).reshape(8, num_features)
    state = game.state.replace(palette=jnp.asarray(features))
    spans = play.screen(play.Game("TrapTube-v0", 0, (state,)))
    picture = np.asarray(tt.render(state, 1))
    food = next(span for span in spans if span.text == "@@")
    assert food.color == tuple(picture[tuple(state.food)].tolist())


@pytest.mark.parametrize(
    ("rgb", "color"),
    [((0, 0, 0), 16), ((255, 0, 0), 196), ((255, 255, 255), 231), ((8, 8, 9), 232)],
)
def test_terminal_colors(rgb, color):
    assert play.terminal_color(rgb) == color


def test_without_a_terminal_the_command_line_says_so(monkeypatch):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    with pytest.raises(ValueError, match="needs a terminal"):
        play.main(play.Arguments())
    with pytest.raises(ValueError, match="unknown task set 'x'"):
        play.main(play.Arguments(task_set="x"))


def test_seeds_draw_the_environments_tasks():
    expected, _ = jax.jit(tt.make("st").reset)(jax.random.key(4))
    np.testing.assert_array_equal(play.new_game("st", 4).state.palette, expected.palette)


def read_until(terminal, text):
    """What the terminal shows up to and including `text`."""
    shown = ""
    while text not in shown:
        ready, _, _ = select.select([terminal], [], [], 120)
        assert ready, f"nothing more after {shown!r}"
        shown += os.read(terminal, 65536).decode()
    return shown


def test_in_a_real_terminal(tmp_path):
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "trap_tube_jax.play", "base", "--out", str(tmp_path)],
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
        for keys, answer in ((b"k", "holds the tool"), (b"z", "saved"), (b"u", "empty")):
            os.write(ours, keys)
            read_until(ours, answer)
        os.write(ours, b"q")
        assert process.wait(timeout=120) == 0
    finally:
        process.kill()
        os.close(ours)
    assert [path.name for path in tmp_path.iterdir()] == ["TrapTube-v0-seed0.npz"]
