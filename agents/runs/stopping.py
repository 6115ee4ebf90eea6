"""Stopping a run by Ctrl-C or SIGTERM."""

import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self


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


class StopSignals:
    """Turns the first Ctrl-C or SIGTERM into a request and the second into KeyboardInterrupt.

    A context manager. In a thread other than the main one, which receives no signals, nothing
    changes.

    Attributes:
      received: number of the first signal, or None.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, on_request: Callable[[], None] = lambda: None, file: Path | None = None):
        self.received: int | None = None
        self._on_request, self._file = on_request, file
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._previous = {n: signal.signal(n, self._handle) for n in self.SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def request(self) -> int | None:
        """Returns the number of the first signal; SIGTERM's if `file` exists; else None."""
        asked = self._file is not None and self._file.exists()
        return self.received or (int(signal.SIGTERM) if asked else None)

    def _handle(self, number: int, frame: Any) -> None:
        del frame
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number
        self._on_request()
