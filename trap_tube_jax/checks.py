"""Shared checks of arguments."""

import difflib
import os
import re
import reprlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

MAX_SEED = 2**32 - 1  # `jax.random.key` keeps the low 32 bits only
MAX_TASKS = 1_000_000  # at a time; their states and keys take 0.3 GB


def check_integer(name: str, value: Any, minimum: int = 1, maximum: int | None = None) -> int:
    """Returns `value` as an int if it is an integer within the bounds, both included.

    Raises:
      ValueError: `value` is a bool, another type or out of bounds.
    """
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_integer or value < minimum or (maximum is not None and value > maximum):
        upper = "" if maximum is None else f" and <= {maximum}"
        raise ValueError(f"{name} must be an integer >= {minimum}{upper}, got {value!r}")
    return int(value)


def expand(path: str | os.PathLike[str]) -> Path:
    """Returns a path, in which a leading `~` stands for the home folder.

    Shells expand `--out ~/x`, but not `--out=~/x`; Python expands neither.

    Raises:
      ValueError: there is no such home folder.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise ValueError(f"{path} cannot be expanded: {error}") from error


def integer_array(name: str, value: Any) -> jax.Array | np.ndarray:
    """Returns `value` as an array of integers of any width; JAX would cut 64 bits to 32.

    Raises:
      ValueError: `value` is ragged or holds something else.
    """
    try:
        array = value if isinstance(value, jax.Array) else np.asarray(value)
    except jax.errors.TracerArrayConversionError:  # a sequence of traced numbers
        array = jnp.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} must be a rectangular array of integers: {error}") from None
    if not jnp.issubdtype(array.dtype, np.integer):
        found = f"{describe_array(array)}: {reprlib.repr(value)}"
        raise ValueError(f"{name} must hold integers, got {found}")
    return array


def describe_array(array: Any) -> str:
    """Returns dtype and shape for a message, such as "uint8[12, 12]"."""
    return f"{array.dtype}{list(array.shape)}"


def check_registered_name(kind: str, name: Any) -> None:
    """Checks a name for command lines and files; `kind` says in messages what the name is for.

    Raises:
      ValueError: `name` has characters other than letters, digits, "_", "." and "-".
    """
    if not isinstance(name, str) or not re.fullmatch(r"[\w.-]+", name, re.ASCII):
        raise ValueError(f"{kind} names consist of letters, digits, '_', '.' and '-', got {name!r}")


def did_you_mean(name: Any, known: Iterable[str]) -> str:
    """Returns " (did you mean ...?)" with at most three known names near `name`, or "".

    Ignores case and blanks.
    """
    by_plain: dict[str, str] = {}
    for candidate in known:
        by_plain.setdefault(_plain(candidate), candidate)
    near = difflib.get_close_matches(_plain(name), by_plain) if isinstance(name, str) else []
    names = " or ".join(repr(by_plain[plain]) for plain in near)
    return f" (did you mean {names}?)" if near else ""


def _plain(name: str) -> str:
    return "".join(name.lower().split())


def check_seed(seed: Any) -> int:
    """Returns `seed` as an int if it is an integer from 0 to 2**32 - 1.

    Raises:
      ValueError: naming the seed and the bounds.
    """
    return check_integer("seed", seed, 0, MAX_SEED)


def check_own_state(state: Any, kind: type) -> None:
    """Checks that `step` got the kind of state that `reset` returns.

    Raises:
      ValueError: `state` is of another type.
    """
    if not isinstance(state, kind):
        raise ValueError(
            f"step takes a {kind.__name__}, got {type(state).__name__}; reset and step return "
            "(state, timestep)"
        )
