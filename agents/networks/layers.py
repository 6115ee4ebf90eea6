"""Layers that all networks share, and the sampling of their kernels.

XLA compiles every random draw separately, which takes seconds for the paper's network with ICM. So
these layers initialise a kernel to `Undrawn`, which holds its standard deviation, and `draw`
samples all kernels at once. `draw` leaves other parameters unchanged.

Source: agents/agent.md, "Network".
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

TRUNCATED_STD = 0.87962566103423978  # a standard normal variable's, truncated at -2 and 2


class Undrawn(struct.PyTreeNode, nn.meta.AxisMetadata):
    """A kernel that `draw` will sample.

    Attributes:
      std: f32[...], the standard deviation of every weight.
    """

    std: jax.Array

    def unbox(self) -> jax.Array:
        """Returns the array that a module sees while it is initialised."""
        return self.std

    def replace_boxed(self, val: Any) -> Any:
        """Returns a kernel of other standard deviations."""
        return self.replace(std=val)

    def add_axis(self, index: int, params: dict[Any, Any]) -> "Undrawn":
        """Returns the kernel unchanged; lifted transforms call this."""
        del index, params
        return self

    def remove_axis(self, index: int, params: dict[Any, Any]) -> "Undrawn":
        """Returns the kernel unchanged; lifted transforms call this."""
        del index, params
        return self


def variance_scaling(scale: float) -> Callable[..., Undrawn]:
    """Returns an initialiser of kernels with variance scale / fan-in, for `draw` to sample."""

    def init(key: jax.Array, shape: Sequence[int], dtype: Any = jnp.float32) -> Undrawn:
        del key
        return Undrawn(jnp.full(shape, np.sqrt(scale / np.prod(shape[:-1])), dtype))

    return init


def draw(key: jax.Array, params: Any) -> Any:
    """Samples every `Undrawn` from a normal distribution truncated at two standard deviations."""
    leaves, structure = jax.tree.flatten(params, is_leaf=_is_undrawn)
    if not any(map(_is_undrawn, leaves)):
        return params
    ends = np.cumsum([jnp.size(nn.meta.unbox(leaf)) for leaf in leaves])
    noise = jax.random.truncated_normal(key, -2, 2, (ends[-1],), jnp.float32) / TRUNCATED_STD
    drawn = [
        leaf.std * part.reshape(leaf.std.shape) if _is_undrawn(leaf) else leaf
        for leaf, part in zip(leaves, jnp.split(noise, ends[:-1]), strict=True)
    ]
    return jax.tree.unflatten(structure, drawn)


def init_module(module: nn.Module, key: jax.Array, *inputs: Any) -> Any:
    """Initialises the parameters of any module, given example inputs of its call.

    Raises AssertionError if the module has other variables than parameters of floats.
    """
    # Only layers of Flax use the folded key.
    variables = module.init(jax.random.fold_in(key, 0), *inputs)
    assert_only_params(variables)
    return draw(key, variables)


def assert_only_params(variables: Any) -> None:
    """Raises AssertionError unless the variables of a module are parameters of floats."""
    assert set(variables) <= {"params"}, f"collections {', '.join(variables)}, not params alone"
    assert_floats(variables)


def assert_floats(params: Any) -> None:
    """Raises AssertionError unless all parameters are floats, since gradients train them."""
    shapes = jax.eval_shape(lambda: params)
    for path, leaf in jax.tree_util.tree_leaves_with_path(shapes):
        name = jax.tree_util.keystr(path)
        assert jnp.issubdtype(leaf.dtype, jnp.floating), f"parameter {name} is {leaf.dtype}"


def _is_undrawn(leaf: Any) -> bool:
    return isinstance(leaf, Undrawn)


hidden_init = variance_scaling(2.0)
output_init = variance_scaling(1.0)
dense = functools.partial(nn.Dense, kernel_init=hidden_init)
output_dense = functools.partial(nn.Dense, kernel_init=output_init)


class Conv(nn.Module):
    """A convolution with `size` x `size` kernels, stride 1 and `features` output channels.

    Padding keeps the board's size; even kernels pad more below and to the right.
    """

    features: int
    size: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps f32[M, H, W, C] to f32[M, H, W, features]."""
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel: Any = self.param("kernel", hidden_init, shape)
        bias: Any = self.param("bias", nn.initializers.zeros, (self.features,), jnp.float32)
        y = jax.lax.conv_general_dilated(
            x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        return y + as_row(bias, x.ndim)


def as_row(vector: jax.Array, ndim: int) -> jax.Array:
    """Reshapes f32[C] to f32[1, ..., 1, C], to add it along the last axis."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))
