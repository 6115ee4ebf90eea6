"""Equality of environments, states and plans by what they hold."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


class ByValue:
    """Mixin: two objects of one type are equal if all their attributes are.

    Arrays are compared by dtype, shape and elements, so that a copy or an unpickled object equals
    the original. Arrays must be concrete.
    """

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and _contents(self) == _contents(other)

    def __hash__(self) -> int:
        return hash((type(self), _contents(self)))


def _contents(owner: Any) -> tuple[Any, ...]:
    leaves, structure = jax.tree.flatten(vars(owner))
    return structure, *map(_comparable, leaves)


def _comparable(leaf: Any) -> Any:
    if not isinstance(leaf, jax.Array | np.ndarray | np.generic):
        return leaf
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    array = np.asarray(leaf)
    return array.dtype, array.shape, array.tobytes()
