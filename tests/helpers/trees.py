"""Pytrees: comparison, rows and copies."""

import copy
import pickle
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest


def rows(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def bits(leaf: Any) -> np.ndarray:
    """Returns an array, or the words of PRNG keys."""
    is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def assert_same(tree: Any, other: Any) -> None:
    """Two trees have the same structure, dtypes and numbers."""
    tree = jax.tree.map(bits, tree)
    other = jax.tree.map(bits, other)
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
