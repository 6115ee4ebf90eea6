"""Draws pictures of results; a picture that fails is a warning, never an error."""

import contextlib
import io
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from trap_tube_jax.command_line import one_line

# Okabe and Ito's palette, which is colour-blind safe.
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")

WIDTH = 8.3  # inches, as in a page 830 pixels wide


@contextlib.contextmanager
def default_style() -> Iterator[None]:
    """Draws under Matplotlib's defaults in the `with` block, alike on every machine.

    Ignores the user's settings, such as a matplotlibrc, and treats `$` as plain text.
    """
    import matplotlib as mpl  # noqa: PLC0415  slow to import

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False
        yield


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


def make_panels(
    titles: Sequence[str], columns: int, height: float, title: str = "", *, sharex: bool = True
) -> tuple[Any, list[Any]]:
    """Makes a figure of Matplotlib with titled panels, in rows of `height` inches."""
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    rows = math.ceil(len(titles) / columns)
    figure = Figure(figsize=(WIDTH, rows * height + 0.9), layout="constrained")
    figure.suptitle(title, parse_math=False)
    grid = figure.subplots(rows, columns, sharex=sharex, sharey=True, squeeze=False)
    axes = list(grid.flat)
    for axis in axes[len(titles) :]:
        axis.remove()
    for axis, name in zip(axes, titles, strict=False):
        axis.set_title(name, fontsize=10)
        axis.grid(alpha=0.3)
        axis.set_axisbelow(True)
        axis.tick_params(labelbottom=True)
    return figure, axes[: len(titles)]
