"""The layers that all networks share, and how they are initialised.

Modules of these layers initialise to standard deviations; `draw` makes parameters of them, all
with a single draw of random numbers. Flax's own initialisers draw once per parameter, and each of
these draws is compiled by itself: compiling the initialisation of the paper's network with ICM
took 37 s that way and 3 s this way, both on a busy two-core machine.

Source: agents/agent.md, "Network".
"""

import functools
from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

TRUNCATED_DEVIATION = 0.87962566103423978  # of a standard normal variable cut off at -2 and 2


def variance_scaling(scale: float) -> nn.initializers.Initializer:
    """Yields the deviation sqrt(scale / fan-in) everywhere in a parameter; see `draw`."""

    def init(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> jax.Array:
        del key
        return jnp.full(shape, np.sqrt(scale / np.prod(shape[:-1])), dtype)

    return init


def draw(key: jax.Array, deviations: Any) -> Any:
    """Parameters from a tree of deviations: normal, truncated at two deviations.

    The draws are rescaled, so that truncation does not lower their deviation.
    """
    leaves, structure = jax.tree.flatten(deviations)
    sizes = [leaf.size for leaf in leaves]
    noise = jax.random.truncated_normal(key, -2, 2, (sum(sizes),)) / TRUNCATED_DEVIATION
    parts = jnp.split(noise, np.cumsum(sizes)[:-1])
    drawn = [leaf * part.reshape(leaf.shape) for leaf, part in zip(leaves, parts, strict=True)]
    return jax.tree.unflatten(structure, drawn)


def init_module(module: nn.Module, key: jax.Array, *inputs: Any) -> Any:
    """Parameters of a module of these layers, given what it is called with."""
    unused_key = jax.random.key(0)
    return draw(key, module.init(unused_key, *inputs))


hidden_init = variance_scaling(2.0)
output_init = variance_scaling(1.0)
dense = functools.partial(nn.Dense, kernel_init=hidden_init)
output_dense = functools.partial(nn.Dense, kernel_init=output_init)


def as_row(vector: jax.Array, ndim: int) -> jax.Array:
    """f32[1, ..., 1, C], to add f32[C] along the last axis."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))
