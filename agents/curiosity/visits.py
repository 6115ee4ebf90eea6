"""Visits within an episode."""

import jax
import jax.numpy as jnp


def visits(identity: jax.Array) -> jax.Array:
    """Returns f32[T, B], how often each i32[T, B] has occurred in its column up to its own row."""
    time = jnp.arange(len(identity), dtype=jnp.int32)
    same = identity[:, None] == identity[None]
    so_far = (time[:, None] >= time[None])[..., None]
    return jnp.sum(same & so_far, axis=1, dtype=jnp.float32)


def first_visits(identity: jax.Array) -> jax.Array:
    """Returns f32[T, B], 1 where i32[T, B] is new in its column, else 0."""
    return (visits(identity) == 1).astype(jnp.float32)
