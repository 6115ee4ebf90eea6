"""The terminal of a command."""

import os
import signal
import sys
from typing import Any

from rich.console import Console

from trap_tube_jax import interruptions


class CommandConsole(Console):
    """A console whose closed pipe, as in `command | head -1`, stops the command like a signal.

    Lines change in place only on a terminal that can do so, whatever FORCE_COLOR says.
    """

    def __init__(self, **options: Any):
        is_terminal = sys.stdout.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
        super().__init__(force_terminal=is_terminal, **options)

    def on_broken_pipe(self) -> None:
        """Ends the command; rich calls this when stdout is closed."""
        self.quiet = True
        interruptions.close_stdout()
        interruptions.handle_signal(signal.SIGPIPE)
