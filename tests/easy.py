"""A board on which random actions succeed soon, comparison and copies of values, 64-bit types."""

import copy
import importlib
import pickle
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt

EASY = tt.State.from_ascii(["TA.F........", *["." * 12] * 11])
RIGHT, DOWN = jnp.array((3, 3)), jnp.array((3, 1))


def enable_x64(enabled: bool) -> Any:
    """The context manager of this name, which JAX before 0.8 keeps elsewhere."""
    home: Any = jax if hasattr(jax, "enable_x64") else importlib.import_module("jax.experimental")
    return home.enable_x64(enabled)


def rows(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def bits(leaf: Any) -> np.ndarray:
    """Returns an array, or the words of PRNG keys."""
    is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def assert_same(tree: Any, other: Any) -> None:
    """Two trees have the same structure, dtypes and numbers."""
    tree, other = jax.tree.map(bits, tree), jax.tree.map(bits, other)
    chex.assert_trees_all_equal_structs(tree, other)
    chex.assert_trees_all_equal_dtypes(tree, other)
    jax.tree.map(np.testing.assert_array_equal, tree, other)


def cloudpickled(value: Any) -> Any:
    cloudpickle = pytest.importorskip("cloudpickle")
    return pickle.loads(cloudpickle.dumps(value))


COPIES = {
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "cloudpickle": cloudpickled,
    "deepcopy": copy.deepcopy,
}
