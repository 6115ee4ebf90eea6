"""Visits within an episode."""

import jax
import jax.numpy as jnp


def first_visits(identity: jax.Array) -> jax.Array:
    """Returns f32[T, B], 1 where i32[T, B] is new in its column, else 0."""
    time = jnp.arange(len(identity), dtype=jnp.int32)
    same = identity[:, None] == identity[None]
    earlier = (time[:, None] > time[None])[..., None]
    return 1.0 - jnp.any(same & earlier, axis=1).astype(jnp.float32)
