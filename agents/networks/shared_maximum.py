"""The maximum over vmapped axes."""

import jax
import jax.numpy as jnp


@jax.custom_batching.custom_vmap
def shared_maximum(x: jax.Array) -> jax.Array:
    """The maximum of a scalar over all vmapped axes, the same in every batch element.

    A loop whose trip count differs between batch elements has to carry both outcomes of
    every element through selects; one that runs as long as the longest does not.
    """
    return x


@shared_maximum.def_vmap
def _(axis_size: int, in_batched: list[bool], x: jax.Array) -> tuple[jax.Array, bool]:
    del axis_size, in_batched
    return shared_maximum(jnp.max(x)), False
