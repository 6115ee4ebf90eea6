"""What the command lines share."""

import contextlib
import sys
from collections.abc import Iterator
from typing import Annotated

import tyro

# An option without a value.
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]

# --import MODULE, as often as there are modules; `imports.import_modules` takes them.
Imports = Annotated[
    tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="import", metavar="MODULE")
]


@contextlib.contextmanager
def plain_errors() -> Iterator[None]:
    """Ends the process with status 2 and one line, in place of a traceback.

    For what the user gave: a ValueError, or an OSError such as a folder that cannot be written.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
