"""Stopping a run by Ctrl-C or SIGTERM."""

import signal
from collections.abc import Callable
from typing import Any, Self

AGAIN = "press Ctrl-C again to stop at once"


class Stopped(Exception):  # noqa: N818  it is no error
    """Training was asked to stop and has saved.

    Attributes:
      signal: the number of the signal, which another process may have received.
    """

    def __init__(self, number: int):
        super().__init__(f"signal {number}")
        self.signal = number


class StopSignals:
    """Turns the first Ctrl-C or SIGTERM into a request, and the second into an exception."""

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self, on_request: Callable[[], None]):
        self.received: int | None = None
        self._on_request = on_request
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._previous = {number: signal.signal(number, self._handle) for number in self.SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def end_process(self) -> None:
        """Lets further signals end the process at once, as they do by default."""
        for number in self.SIGNALS:
            signal.signal(number, signal.SIG_DFL)

    def _handle(self, number: int, frame: Any) -> None:
        del frame
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number
        self._on_request()
