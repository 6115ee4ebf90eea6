"""Errors in a line, and words that any terminal can show."""

import argparse
import io
import signal
import subprocess
import sys

import numpy as np
import pytest

import trap_tube_jax as tt
from trap_tube_jax.command_line import path_argument, plain_errors
from trap_tube_jax.imports import needs_extra


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ValueError("no such set"), 2),
        (ImportError("no such library"), 2),
        (PermissionError("no such folder"), 1),
    ],
)
def test_commands_end_with_one_line(error, code, capsys):
    with pytest.raises(SystemExit, match=str(code)), plain_errors():
        raise error
    assert capsys.readouterr().err == f"error: {error}\n"


def test_a_leading_tilde_is_the_home_folder(monkeypatch, tmp_path):
    """Also where no shell expands it, as in --output=~/x and in Python."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    monkeypatch.chdir(tmp_path)
    tt.save_gif(np.zeros((1, 4, 4, 3), np.uint8), "~/black.gif")
    assert (tmp_path / "home" / "black.gif").exists()
    assert path_argument("~/black.gif") == tmp_path / "home" / "black.gif"


def test_a_path_that_cannot_be_expanded_says_why():
    words = "~nobody-of-this-name/x cannot be expanded: "
    with pytest.raises(argparse.ArgumentTypeError, match=words):
        path_argument("~nobody-of-this-name/x")


def test_an_error_is_one_line(capsys):
    with pytest.raises(SystemExit), plain_errors():
        raise ValueError("no set\nof this name")
    shown = capsys.readouterr().err
    assert shown == "error: no set of this name\n"


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_any_terminal_shows_the_characters_that_it_knows(encoding, monkeypatch):
    output = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", output)
    with plain_errors():
        print("{Sy} 3–4 %, Größe →")
    shown = output.buffer.getvalue().decode(encoding)
    assert shown.startswith("{Sy} 3")
    assert shown.count("?") == {"ascii": 4, "utf-8": 0}[encoding]


def test_a_closed_pipe_ends_a_command_in_silence():
    lines = "with plain_errors():\n    for number in range(100_000): print(number)"
    program = f"from trap_tube_jax.command_line import plain_errors\n{lines}"
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == b"0\n"
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 128 + signal.SIGPIPE


def test_a_command_without_stdout_ends_in_silence(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with plain_errors():
        print("as under command >&-")


def test_a_missing_module_is_named_with_the_extra():
    """It may be one that a library of the extra needs."""
    message = r"this needs the module 'nonesuch': pip install 'trap-tube-jax\[pictures\]'"
    with pytest.raises(ImportError, match=message), needs_extra("pictures"):
        import nonesuch  # pyright: ignore[reportMissingImports]  # noqa: F401, PLC0415
