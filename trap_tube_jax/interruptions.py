"""Ends commands on a signal: one line, the exit code 128 + number, and saved work.

A signal ends a command at once, whatever it computes, except within `deferring`, which lets it
finish and save what it has begun.
"""

import contextlib
import dataclasses
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

# Ctrl-C, the end of a job, a closed terminal, and the warning before the end of a Slurm job.
NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
SIGNALS = tuple(getattr(signal, name) for name in NAMES if hasattr(signal, name))
FINISHING = "Finishing the current iteration; Ctrl-C again stops now."
SHOW_CURSOR = "\x1b[?25h"  # a progress line hides it


class Stopped(Exception):  # noqa: N818  not an error
    """The program was asked to stop and has saved.

    Attributes:
      signal: number of the signal.
    """

    def __init__(self, number: int):
        super().__init__(f"signal {number}")
        self.signal = number


@dataclasses.dataclass(eq=False)  # two blocks with the same function differ
class _DeferredSignal:
    """An open `deferring` block, and the number of the first signal in it."""

    on_first: Callable[[], object]
    received: int | None = None


def _start_again() -> str:
    """Returns the hint of a command that saves no progress."""
    return "The same command starts again."


class _Process:
    """Holds how this process answers the next signal."""

    def __init__(self) -> None:
        self.is_command = False  # False in a caller's process, such as a notebook
        self.terminal_modes: Any = None  # before the command changes them
        self.hint: Callable[[], str] = _start_again
        self.blocks: list[_DeferredSignal] = []  # open `deferring` blocks, innermost last


_process = _Process()


def handle_signal(number: int) -> None:
    """Handles a signal, or an event that ends a command like one, such as a closed pipe.

    Raises:
      KeyboardInterrupt: outside a command, if no `deferring` block takes the signal.
    """
    if os.isatty(2):
        _write("")  # a line of progress, or "^C", may stand there
    block = _process.blocks[-1] if _process.blocks else None
    if block is not None and block.received is None:
        _write(FINISHING)  # before the program can see the signal, and print its own end
        block.received = number
        block.on_first()
    elif _process.is_command:
        try:
            _restore_terminal()
            _write_stopped()
        finally:
            os._exit(128 + number)  # a normal exit can crash in the compiler's threads
    else:
        raise KeyboardInterrupt


@contextlib.contextmanager
def deferring(
    on_first: Callable[[], object] = lambda: None,
) -> Iterator[Callable[[], int | None]]:
    """Defers the first signal, and calls `on_first` when it comes; a second one ends at once.

    Yields a function that returns the number of the first signal, or None. Outside a command, only
    the main thread receives signals.
    """
    block = _DeferredSignal(on_first)
    is_main = threading.current_thread() is threading.main_thread()
    receives = is_main or _process.is_command
    before = {}
    if receives:
        _process.blocks.append(block)
    if not _process.is_command:
        before = _install_handlers(lambda number, _: handle_signal(number))
    try:
        yield lambda: block.received
    finally:
        if receives:
            _process.blocks.remove(block)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def exit_when_stopped(hint: Callable[[], str]) -> Iterator[None]:
    """Ends with a line in which `hint` says how to go on, and the exit code 128 + number.

    An empty hint prints no line.

    Raises:
      SystemExit: `Stopped` or KeyboardInterrupt was raised within.
    """
    before = _process.hint
    _process.hint = hint
    try:
        yield
    except (Stopped, KeyboardInterrupt) as stopped:
        _write_stopped()
        number = stopped.signal if isinstance(stopped, Stopped) else signal.SIGINT
        raise SystemExit(128 + number) from None
    finally:
        _process.hint = before


def run_command(main: Callable[[], Any]) -> None:
    """Runs the command line that this process is for.

    Signals are read by a thread, since Python's handlers wait for a running compiler or program.
    """
    _process.is_command = True
    _process.terminal_modes = _terminal_modes()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reader,), daemon=True).start()
    _install_handlers(lambda *_: None)  # for good, so that no signal causes a traceback
    with exit_when_stopped(_start_again):
        main()


def block_signals() -> None:
    """Keeps signals from this thread and from the processes that it starts."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)


def close_stdout() -> None:
    """Redirects stdout to the null device, or Python would report the closed pipe at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _watch(reader: int) -> None:
    while True:
        for number in os.read(reader, 64):
            if number in SIGNALS:
                handle_signal(number)


def _install_handlers(handler: Any) -> dict[int, Any]:
    """Handles the signals that the process does not ignore, as `nohup` asks for SIGHUP.

    Returns the handlers before.
    """
    is_main = threading.current_thread() is threading.main_thread()
    handled = [n for n in SIGNALS if is_main and signal.getsignal(n) is not signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in handled}


def _terminal_modes() -> Any:
    """Returns the modes of the terminal that stdin is, such as echo; None if it is none."""
    with contextlib.suppress(Exception):
        import termios  # noqa: PLC0415  Windows has none

        return termios.tcgetattr(0)


def _restore_terminal() -> None:
    """Shows the cursor, and restores the modes that a game or a prompt for a password changes."""
    if sys.stdout is not None and sys.stdout.isatty():
        _write(SHOW_CURSOR, end="")
    with contextlib.suppress(Exception):  # there is no terminal, or it is closed
        import termios  # noqa: PLC0415

        if _process.terminal_modes and os.tcgetpgrp(0) == os.getpgrp():  # not in the background
            termios.tcsetattr(0, termios.TCSANOW, _process.terminal_modes)


def _write_stopped() -> None:
    if hint := _process.hint():
        _write(f"Stopped. {hint}")


def _write(text: str, end: str = "\n") -> None:
    """Writes to stderr, past Python's buffers, whose locks another thread may hold."""
    with contextlib.suppress(OSError):
        os.write(2, (text + end).encode(errors="replace"))
