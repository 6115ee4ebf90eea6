"""Signals end a command with one line and their code, whatever it does, or are deferred."""

import os
import signal
import subprocess
import sys

import pytest

from trap_tube_jax.interruptions import FINISHING, SIGNALS

PROGRAM = """
import contextlib, hashlib, signal
from trap_tube_jax.interruptions import Stopped, deferring, run_command, exit_when_stopped

def compute():  # in C, as XLA does: Python's signal handlers wait until it returns
    print("ready", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)

def main():
    with {hint}:
        {body}

run_command(main)
"""
HINT = 'exit_when_stopped(lambda: "Go on like this.")'
NO_HINT = "contextlib.nullcontext()"
AT_ONCE = "compute()"
SAVES = """with deferring() as request:
            print("ready", flush=True)
            while not request():
                pass
            raise Stopped(request())"""
NEVER_SAVES = """with deferring():
            compute()"""


def start(body, hint=HINT, **options):
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    program = PROGRAM.format(body=body, hint=hint)
    return subprocess.Popen([sys.executable, "-c", program], text=True, **options)


@pytest.mark.parametrize(
    ("body", "hint", "times", "lines"),
    [
        (AT_ONCE, HINT, 1, ["Stopped. Go on like this."]),
        (SAVES, HINT, 1, [FINISHING, "Stopped. Go on like this."]),
        (NEVER_SAVES, HINT, 2, [FINISHING, "Stopped. Go on like this."]),
        (AT_ONCE, NO_HINT, 1, ["Stopped. The same command starts again."]),
        (SAVES, NO_HINT, 1, [FINISHING, "Stopped. The same command starts again."]),
    ],
)
def test_a_signal_ends_a_command_with_one_line_and_its_code(body, hint, times, lines):
    processes = {number: start(body, hint) for number in SIGNALS}
    ends = {}
    for number, process in processes.items():
        with process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            assert process.stderr is not None
            errors = ""
            for _ in range(times):
                process.send_signal(number)
                errors += process.stderr.readline()  # equal signals that come together are one
            errors += process.stderr.read()
        ends[number] = (process.returncode, errors.splitlines())
    assert ends == {number: (128 + number, lines) for number in SIGNALS}


def test_on_a_terminal_the_words_begin_a_line():
    """After a line of progress, and the "^C" of the terminal."""
    pty = pytest.importorskip("pty")
    terminal, errors = pty.openpty()
    with start(SAVES, stderr=errors) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
    shown = os.read(terminal, 1024).decode()
    assert shown.splitlines()[:2] == ["", FINISHING]
    os.close(terminal)
    os.close(errors)


def test_ignored_signals_stay_ignored():
    """As `nohup` ignores SIGHUP."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # which a new process inherits
    try:
        process = start(SAVES)
    finally:
        signal.signal(signal.SIGHUP, before)
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
    assert process.returncode == 128 + signal.SIGTERM


def test_outside_a_command_a_second_signal_is_a_keyboard_interrupt():
    """A notebook goes on after it."""
    program = """
import signal
from trap_tube_jax.interruptions import deferring
try:
    with deferring() as request:
        signal.raise_signal(signal.SIGINT)
        assert request() == signal.SIGINT
        signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    print("goes on")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert done.stdout == b"goes on\n"


def test_a_block_around_another_takes_its_own_signal():
    program = """
import signal
from trap_tube_jax.interruptions import deferring
with deferring() as outer:
    with deferring() as inner:
        pass
    signal.raise_signal(signal.SIGINT)
    assert (inner(), outer()) == (None, signal.SIGINT)
print("received")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert done.stdout == b"received\n"


def test_outside_a_command_the_main_thread_alone_receives_signals():
    program = """
import signal, threading
from trap_tube_jax.interruptions import deferring
begun, end = threading.Event(), threading.Event()
def work():
    with deferring():
        begun.set()
        end.wait()
thread = threading.Thread(target=work)
with deferring() as request:
    thread.start()
    begun.wait()
    signal.raise_signal(signal.SIGINT)
    end.set()
    thread.join()
    assert request() == signal.SIGINT
    print("received")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert done.stdout == b"received\n"
