"""Draws Matplotlib figures alike on every machine."""

import contextlib
from collections.abc import Iterator

from trap_tube_jax.imports import needs_extra


@contextlib.contextmanager
def default_style() -> Iterator[None]:
    """Draws under Matplotlib's defaults in the `with` block.

    Ignores the user's settings, such as a matplotlibrc, and treats `$` as plain text.

    Raises:
      ImportError: matplotlib is not installed.
    """
    with needs_extra("pictures"):
        import matplotlib as mpl  # noqa: PLC0415  slow to import
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["text.parse_math"] = False
        yield
