"""The names by which `Config.curiosity` knows intrinsic rewards.

A table of its own, below everything else, so that settings can be checked without the modules
that the names stand for. `agents.curiosity` fills it; a module of your own may add to it.
"""

from collections.abc import Callable
from typing import Any

# From the settings and the environment to an `agents.curiosity.Curiosity`.
CuriosityFactory = Callable[[Any, Any], Any]

_curiosities: dict[str, CuriosityFactory] = {}


def register_curiosity(name: str, factory: CuriosityFactory) -> None:
    """Makes a curiosity known by a name.

    Args:
      name: what `Config.curiosity` calls it.
      factory: `factory(config, env)` returns the `Curiosity`.

    Raises:
      ValueError: the name is taken.
    """
    if name in _curiosities:
        raise ValueError(f"curiosity {name!r} is registered already; known: {known()}")
    _curiosities[name] = factory


def curiosities() -> tuple[str, ...]:
    """The names that are known."""
    return tuple(_curiosities)


def curiosity_factory(name: str) -> CuriosityFactory:
    """What was registered under this name.

    Raises:
      ValueError: nothing was.
    """
    if name not in _curiosities:
        raise ValueError(f"unknown curiosity {name!r}; known: {known()}")
    return _curiosities[name]


def known() -> str:
    """The names that are known, for people."""
    return ", ".join(_curiosities)
