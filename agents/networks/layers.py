"""The layers that all networks share, and how they are initialised.

Source: agents/agent.md, "Network".
"""

import functools

import flax.linen as nn
import jax

# Truncated normal with variance scale / fan-in.
hidden_init = nn.initializers.variance_scaling(2.0, "fan_in", "truncated_normal")
output_init = nn.initializers.variance_scaling(1.0, "fan_in", "truncated_normal")
dense = functools.partial(nn.Dense, kernel_init=hidden_init)
output_dense = functools.partial(nn.Dense, kernel_init=output_init)


def as_row(vector: jax.Array, ndim: int) -> jax.Array:
    """f32[1, ..., 1, C], to add f32[C] along the last axis."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))
