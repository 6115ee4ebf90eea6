"""Names of intrinsic rewards and encoders, filled by `agents.curiosity` and `agents.networks`."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from flax.errors import FlaxError

from trap_tube_jax.checks import check_registered_name, did_you_mean


class Registry(dict[str, Callable[..., Any]]):
    """Factories by name: the built-in ones, and those added by `register`."""

    def __init__(self, kind: str):
        super().__init__()
        self.kind = kind  # in messages
        self.registered: set[str] = set()

    def register(self, name: str, factory: Callable[..., Any]) -> None:
        """Registers a factory, or replaces one registered earlier under the same name.

        Raises:
          ValueError: the name is built in or has characters other than letters, digits, "_", "."
            and "-".
        """
        check_registered_name(self.kind, name)
        if name in self and name not in self.registered:
            raise ValueError(f"{self.kind} {name!r} is built in; names taken: {', '.join(self)}")
        self[name] = factory
        self.registered.add(name)

    def factory(self, name: str) -> Callable[..., Any]:
        """Returns the factory of this name; ValueError lists the names if there is none."""
        if name not in self:
            raise ValueError(
                f"unknown {self.kind} {name!r}{did_you_mean(name, self)}; "
                f"allowed: {', '.join(self)}. If a module of yours registers it, name the module: "
                "--import MODULE, or imports=[...] in Python"
            )
        return self[name]


curiosities = Registry("curiosity")
encoders = Registry("encoder")


@contextlib.contextmanager
def contract(kind: str, name: str) -> Iterator[None]:
    """Turns an error of a registered object into a ValueError of one line that names it."""
    try:
        yield
    except (AssertionError, FlaxError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{kind} {name!r} breaks its contract: {reason}") from error
