"""Pictures of results, which never cost the results."""

import contextlib
import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from trap_tube_jax.command_line import one_line
from trap_tube_jax.figures import default_style

# Okabe and Ito's palette, which is colour-blind safe.
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")


@contextlib.contextmanager
def drawing(path: Path) -> Iterator[None]:
    """Draws the file `path` in the `with` block; an error costs one line of warning."""
    try:
        with default_style():
            yield
    except Exception as error:  # whatever a library raises
        print(f"warning: {path} was not drawn: {one_line(error)}", file=sys.stderr)


def to_png(figure: Any, dpi: int) -> bytes:
    """Returns a figure of Matplotlib as PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return file.getvalue()
