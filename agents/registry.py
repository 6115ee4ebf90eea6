"""Names of intrinsic rewards and encoders, filled by `agents.curiosity` and `agents.networks`."""

import contextlib
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

from flax.errors import FlaxError

from trap_tube_jax.checks import check_registered_name, did_you_mean


class Registry(dict[str, Callable[..., Any]]):
    """Factories by name: the built-in ones, and those added by `register`.

    Messages name the `kind`; `arguments` are the names of a factory's arguments.
    """

    def __init__(self, kind: str, *arguments: str):
        super().__init__()
        self.kind = kind
        self.arguments = arguments
        self.registered: set[str] = set()

    def register(self, name: str, factory: Callable[..., Any]) -> None:
        """Registers a factory, or replaces one registered earlier under the same name.

        Raises:
          ValueError: the name is built in or has characters other than letters, digits, "_", "."
            and "-"; or the factory does not take the arguments.
        """
        check_registered_name(self.kind, name)
        if name in self and name not in self.registered:
            raise ValueError(f"{self.kind} {name!r} is built in; names taken: {', '.join(self)}")
        self._check_factory(name, factory)
        self[name] = factory
        self.registered.add(name)

    def _check_factory(self, name: str, factory: Any) -> None:
        try:
            inspect.signature(factory).bind(*self.arguments)
        except TypeError as error:
            raise ValueError(
                f"{self.kind} {name!r} needs a function of ({', '.join(self.arguments)}): {error}"
            ) from error

    def factory(self, name: str) -> Callable[..., Any]:
        """Returns the factory of this name; ValueError lists the names if there is none."""
        if name not in self:
            raise ValueError(
                f"unknown {self.kind} {name!r}{did_you_mean(name, self)}; "
                f"allowed: {', '.join(self)}. If a module of yours registers it, name the module: "
                "--import MODULE, or imports=[...] in Python"
            )
        return self[name]


curiosities = Registry("curiosity", "config", "env")
encoders = Registry("encoder", "config")


@contextlib.contextmanager
def contract(kind: str, name: str) -> Iterator[None]:
    """Turns an error of a registered object into a ValueError of one line that names it."""
    try:
        yield
    except (AssertionError, FlaxError) as error:
        reason = re.sub(r"\[Chex\] Assertion \w+ failed: ", "", " ".join(str(error).split()))
        raise ValueError(f"{kind} {name!r} breaks its contract: {reason}") from error
