"""Layers that all networks share, and the sampling of their kernels.

XLA compiles every random draw separately. Drawing each kernel by itself takes 37 s for the paper's
network with ICM. So these layers initialise kernels to NumPy arrays of their standard deviation,
and `draw` samples all kernels at once, in 3 s. Flax's own layers initialise parameters to JAX
arrays, which `draw` leaves unchanged.

Source: agents/agent.md, "Network".
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

TRUNCATED_STD = 0.87962566103423978  # a standard normal variable's, truncated at -2 and 2


def variance_scaling(scale: float) -> Callable[..., np.ndarray]:
    """Returns an initialiser that fills kernels with sqrt(scale / fan-in), for `draw` to sample."""

    def init(key: jax.Array, shape: Sequence[int], dtype: Any = np.float32) -> np.ndarray:
        return np.broadcast_to(np.sqrt(scale / np.prod(shape[:-1])).astype(dtype), shape)

    return init


def draw(key: jax.Array, params: Any) -> Any:
    """Samples kernels from a normal distribution truncated at two standard deviations.

    NumPy arrays in `params` are the standard deviations f32[...] of kernels after truncation; JAX
    arrays stay.
    """
    leaves, structure = jax.tree.flatten(params)
    ends = np.cumsum([leaf.size for leaf in leaves])
    noise = jax.random.truncated_normal(key, -2, 2, (ends[-1],), jnp.float32) / TRUNCATED_STD
    drawn = [
        leaf * part.reshape(leaf.shape) if isinstance(leaf, np.ndarray) else leaf
        for leaf, part in zip(leaves, jnp.split(noise, ends[:-1]), strict=True)
    ]
    return jax.tree.unflatten(structure, drawn)


def init_module(module: nn.Module, key: jax.Array, *inputs: Any) -> Any:
    """Initialises the parameters of any module, given example inputs of its call."""
    # Only layers of Flax use the folded key.
    return draw(key, module.init(jax.random.fold_in(key, 0), *inputs))


hidden_init = variance_scaling(2.0)
output_init = variance_scaling(1.0)
dense = functools.partial(nn.Dense, kernel_init=hidden_init)
output_dense = functools.partial(nn.Dense, kernel_init=output_init)


def as_row(vector: jax.Array, ndim: int) -> jax.Array:
    """Reshapes f32[C] to f32[1, ..., 1, C], to add it along the last axis."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))
