"""A board on which random actions succeed soon, and how to compare states."""

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np

import trap_tube_jax as tt

EASY = tt.State.from_ascii(["TA.F........", *["." * 12] * 11])
RIGHT, DOWN = jnp.array((3, 3)), jnp.array((3, 1))


def rows(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def assert_same(tree: Any, other: Any) -> None:
    chex.assert_trees_all_equal_structs(tree, other)
    chex.assert_trees_all_equal_dtypes(tree, other)
    jax.tree.map(np.testing.assert_array_equal, tree, other)
