"""Settings of JAX: 64-bit types, and those under which recorded draws do not hold."""

import importlib
from typing import Any

import jax
import pytest

IS_THREEFRY = str(jax.random.key_impl(jax.random.key(0))) == "threefry2x32"
# `jax.random.randint` draws other numbers of 64 bits.
HAS_DEFAULT_DRAWS = IS_THREEFRY and jax.numpy.arange(1).dtype == "int32"

needs_threefry = pytest.mark.skipif(
    not IS_THREEFRY, reason="draws of rbg keys are not those of Threefry, and depend on jax.vmap"
)


def enable_x64(enabled: bool) -> Any:
    """The context manager of this name, which JAX before 0.8 keeps elsewhere."""
    home: Any = jax if hasattr(jax, "enable_x64") else importlib.import_module("jax.experimental")
    return home.enable_x64(enabled)
