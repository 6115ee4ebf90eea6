"""The names by which `Config` knows intrinsic rewards and encoders.

Kept apart from the modules that fill them, `agents.curiosity` and `agents.networks`, because those
import `Config`. A module of your own may add to them (agents/extending.md).
"""

from collections.abc import Callable
from typing import Any

from trap_tube_jax.checks import check_registered_name
from trap_tube_jax.imports import registering_file


class Registry:
    """Factories of one kind, by name."""

    def __init__(self, kind: str):
        """An empty table; `kind` is what messages call an entry."""
        self.kind = kind
        self._factories: dict[str, Callable[..., Any]] = {}
        self._files: dict[str, str] = {}  # by name: what has registered it

    def register(self, name: str, factory: Callable[..., Any]) -> None:
        """Makes something known by a name.

        The file or notebook that has registered a name may register it again; what it registers
        last is made from then on.

        Args:
          name: what the settings call it: letters, digits, "_", "." and "-".
          factory: the function or class that makes it from the settings.

        Raises:
          ValueError: the name is taken by the project or by another file, or has other characters,
            or `factory` cannot be called.
        """
        check_registered_name(self.kind, name)
        if not callable(factory):
            raise ValueError(
                f"{self.kind} {name!r} needs a function that makes it, such as `lambda *_: made`, "
                f"got {factory!r}"
            )
        file = registering_file()
        if name in self._factories and self._files.get(name) != file:
            known = ", ".join(self.names())
            raise ValueError(f"{self.kind} {name!r} is registered already; taken: {known}")
        self._factories[name] = factory
        self._files[name] = file

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
