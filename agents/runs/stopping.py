"""Stopping a run by Ctrl-C or SIGTERM."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


class Stopped(Exception):  # noqa: N818  not an error
    """Training was asked to stop and has saved.

    Attributes:
      signal: number of the signal.
    """

    def __init__(self, number: int):
        super().__init__(f"signal {number}")
        self.signal = number


def exit_code(stopped: Stopped | KeyboardInterrupt) -> int:
    """Returns the exit code of a command that a signal has stopped."""
    return 128 + (stopped.signal if isinstance(stopped, Stopped) else signal.SIGINT)


@contextlib.contextmanager
def stop_signals(
    say: Callable[[str], None], file: Path | None = None
) -> Iterator[Callable[[], int | None]]:
    """Turns the first Ctrl-C or SIGTERM into a request and the second into KeyboardInterrupt.

    Yields a function that returns the number of the first signal, SIGTERM's if `file` exists, or
    None. A thread other than the main one receives no signals.
    """
    received: list[int] = []

    def handle(number: int, _: Any) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)
        say("Finishing the current iterations; Ctrl-C again stops now.")

    def request() -> int | None:
        asked = file is not None and file.exists()
        return received[0] if received else int(signal.SIGTERM) if asked else None

    is_main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if is_main else ()
    previous = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
