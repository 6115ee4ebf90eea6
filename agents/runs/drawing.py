"""Pictures of results, which never cost the results."""

import contextlib
import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from trap_tube_jax.command_line import one_line


@contextlib.contextmanager
def drawing(path: Path) -> Iterator[None]:
    """Draws the file `path` in the `with` block, under Matplotlib's defaults.

    Settings of the reader's machine, such as a matplotlibrc, do not count, and `$` is plain text.
    An error in the block costs one line of warning.
    """
    try:
        import matplotlib as mpl  # noqa: PLC0415  slow to import

        with mpl.rc_context():
            mpl.rcdefaults()
            mpl.rcParams["text.parse_math"] = False
            yield
    except Exception as error:  # whatever a library raises
        print(f"warning: {path} was not drawn: {one_line(error)}", file=sys.stderr)


def to_png(figure: Any, dpi: int) -> bytes:
    """Returns a figure of Matplotlib as PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return file.getvalue()
