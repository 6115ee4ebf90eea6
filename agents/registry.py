"""The names by which `Config` knows intrinsic rewards and encoders.

Kept apart from the modules that fill them, `agents.curiosity` and `agents.networks`, because those
import `Config`. A module of your own may add to them (agents/extending.md).
"""

from collections.abc import Callable
from typing import Any


class Registry:
    """Factories of one kind, by name."""

    def __init__(self, kind: str):
        """An empty table; `kind` is what messages call an entry."""
        self.kind = kind
        self._factories: dict[str, Callable[..., Any]] = {}

    def register(self, name: str, factory: Callable[..., Any]) -> None:
        """Makes something known by a name.

        Args:
          name: what the settings call it.
          factory: what makes it from the settings.

        Raises:
          ValueError: the name is taken.
        """
        if name in self._factories:
            known = ", ".join(self.names())
            raise ValueError(f"{self.kind} {name!r} is registered already; taken: {known}")
        self._factories[name] = factory

    def names(self) -> tuple[str, ...]:
        """All names, in the order of registration."""
        return tuple(self._factories)

    def factory(self, name: str) -> Callable[..., Any]:
        """What was registered under this name.

        Raises:
          ValueError: nothing was.
        """
        if name not in self._factories:
            known = ", ".join(self.names())
            raise ValueError(f"unknown {self.kind} {name!r}; allowed: {known}")
        return self._factories[name]


curiosities = Registry("curiosity")
encoders = Registry("encoder")
