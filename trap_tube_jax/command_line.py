"""Shared parts of the command lines."""

import argparse
import contextlib
import io
import sys
from collections.abc import Iterator
from pathlib import Path

from trap_tube_jax.checks import expand
from trap_tube_jax.interruptions import close_stdout

CLOSED_PIPE = 128 + 13  # as by SIGPIPE, which Windows lacks


def prepare_terminal() -> None:
    """Lets stdout and stderr print "?" for characters that their encoding lacks."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def one_line(error: Exception) -> str:
    """Returns the message of an error as one line."""
    return " ".join(str(error).split())


def announce(work: str) -> None:
    """Announces on stderr a step that takes seconds or more, with its expected duration."""
    sys.stderr.write(f"{work} ...\n")  # at once, unlike `print`: a signal may come between
    sys.stderr.flush()


@contextlib.contextmanager
def plain_errors() -> Iterator[None]:
    """Prepares the terminal, and ends the process with one line in place of a traceback.

    The exit code is 2 for a ValueError or a missing library, 1 for an OSError such as a full
    disk. A closed pipe, as in `command | head -1`, ends it without a line, as by SIGPIPE.
    """
    prepare_terminal()
    try:
        yield
        print(end="", flush=True)  # does nothing where stdout is closed, unlike sys.stdout.flush
    except BrokenPipeError:
        close_stdout()
        raise SystemExit(CLOSED_PIPE) from None
    except (ValueError, ImportError, OSError) as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        raise SystemExit(1 if isinstance(error, OSError) else 2) from error


def path_argument(text: str) -> Path:
    """Returns a path, for `add_argument(type=...)`; see `expand`.

    Raises:
      ArgumentTypeError: with the message of `expand`, which argparse would hide.
    """
    try:
        return expand(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add_import_option(parser: argparse.ArgumentParser) -> None:
    """Adds `--import MODULE` as `imports`, a list for `import_modules`."""
    parser.add_argument(
        "--import",
        dest="imports",
        action="append",
        default=[],
        metavar="MODULE",
        help="import a module first, for the task sets that it registers; repeatable",
    )
