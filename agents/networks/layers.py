"""The layers that all networks share, and how they are initialised.

Kernels of these layers initialise to a `Deviation`; `draw` makes parameters of all of them with a
single draw of random numbers. Flax's own initialisers draw once per parameter, and each of
these draws is compiled by itself: compiling the initialisation of the paper's network with ICM
took 37 s that way and 3 s this way, both on a busy two-core machine. Layers of Flax may stand
beside these, and start as Flax has it.

Source: agents/agent.md, "Network".
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Self

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from flax.core import meta

TRUNCATED_DEVIATION = 0.87962566103423978  # of a standard normal variable cut off at -2 and 2


class Deviation(struct.PyTreeNode, meta.AxisMetadata):
    """A parameter that is still to be drawn.

    Modules see its value in the meantime.

    Attributes:
      value: f32[...], its standard deviation.
    """

    value: jax.Array

    def unbox(self) -> jax.Array:
        """The value."""
        return self.value

    def replace_boxed(self, val: Any) -> Self:
        """The same with another value."""
        return self.replace(value=val)

    def add_axis(self, index: int, params: dict[Any, Any]) -> Self:
        """Itself: axes have no names."""
        return self

    remove_axis = add_axis


def variance_scaling(scale: float) -> Callable[..., Any]:
    """An initialiser of a `Deviation`, sqrt(scale / fan-in) everywhere; it does not use its key."""

    def init(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Deviation:
        return Deviation(jnp.full(shape, np.sqrt(scale / np.prod(shape[:-1])), dtype))

    return init


def draw(key: jax.Array, params: Any) -> Any:
    """Draws what is still to be drawn of parameters: normal, truncated at two deviations.

    The draws are rescaled, so that truncation does not lower their deviation.

    Args:
      key: PRNG key.
      params: a tree of `Deviation` and of arrays, which stay as they are.
    """
    leaves, structure = jax.tree.flatten(params, is_leaf=_is_deviation)
    values = [leaf.value if _is_deviation(leaf) else leaf for leaf in leaves]
    sizes = [value.size for value in values]
    noise = jax.random.truncated_normal(key, -2, 2, (sum(sizes),)) / TRUNCATED_DEVIATION
    parts = jnp.split(noise, np.cumsum(sizes)[:-1])
    drawn = [
        value * part.reshape(value.shape) if _is_deviation(leaf) else value
        for leaf, value, part in zip(leaves, values, parts, strict=True)
    ]
    return jax.tree.unflatten(structure, drawn)


def init_module(module: nn.Module, key: jax.Array, *inputs: Any) -> Any:
    """Parameters of a module of any layers, given what it is called with."""
    # Layers of Flax draw with the key that they are given; those here leave that to `draw`.
    return draw(key, module.init(jax.random.fold_in(key, 0), *inputs))


def _is_deviation(leaf: Any) -> bool:
    return isinstance(leaf, Deviation)


hidden_init = variance_scaling(2.0)
output_init = variance_scaling(1.0)
dense = functools.partial(nn.Dense, kernel_init=hidden_init)
output_dense = functools.partial(nn.Dense, kernel_init=output_init)


def as_row(vector: jax.Array, ndim: int) -> jax.Array:
    """f32[1, ..., 1, C], to add f32[C] along the last axis."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))
