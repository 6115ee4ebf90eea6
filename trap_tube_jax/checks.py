"""Checks of arguments that several modules share."""

import re
from typing import Any

import numpy as np

LARGEST_SEED = 2**32 - 1  # `jax.random.key` drops what is beyond


def check_integer(name: str, value: Any, minimum: int = 1, maximum: int | None = None) -> int:
    """Returns `value` as an int if it is an integer within the bounds, both included.

    Raises:
      ValueError: naming the argument, its value and the bounds. A bool is no integer.
    """
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_integer or value < minimum or (maximum is not None and value > maximum):
        upper = "" if maximum is None else f" and <= {maximum}"
        raise ValueError(f"{name} must be an integer >= {minimum}{upper}, got {value!r}")
    return int(value)


def check_registered_name(what: str, name: Any) -> None:
    """Checks a name that command lines and file names are to hold; `what` is what it names.

    Raises:
      ValueError: it has other characters than letters, digits, "_", "." and "-".
    """
    if not isinstance(name, str) or not re.fullmatch(r"[\w.-]+", name, re.ASCII):
        raise ValueError(f"{what} names consist of letters, digits, '_', '.' and '-', got {name!r}")


def check_seed(seed: Any) -> int:
    """Returns `seed` as an int if it is an integer from 0 to 2**32 - 1.

    Raises:
      ValueError: naming the seed and the bounds.
    """
    return check_integer("seed", seed, 0, LARGEST_SEED)


def check_own_state(state: Any, kind: type) -> None:
    """Checks that `step` is given the kind of state that its own `reset` returns.

    Raises:
      ValueError: it is something else.
    """
    if not isinstance(state, kind):
        raise ValueError(
            f"step takes a {kind.__name__}, got {type(state).__name__}; reset and step return "
            "(state, timestep)"
        )
