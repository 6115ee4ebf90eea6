"""Settings of JAX under which recorded draws do not hold."""

import jax
import pytest

IS_THREEFRY = str(jax.random.key_impl(jax.random.key(0))) == "threefry2x32"
# `jax.random.randint` draws other numbers of 64 bits.
HAS_DEFAULT_DRAWS = IS_THREEFRY and jax.numpy.arange(1).dtype == "int32"

needs_threefry = pytest.mark.skipif(
    not IS_THREEFRY, reason="draws of rbg keys are not those of Threefry, and depend on jax.vmap"
)
