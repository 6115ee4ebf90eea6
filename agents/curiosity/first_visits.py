"""First visits, counted by episode."""

import jax
import jax.numpy as jnp
import numpy as np


def first_visits(identity: jax.Array) -> jax.Array:
    """Returns f32[B, T], 1 where integer[B, T] is new in its episode, else 0."""
    time = np.arange(identity.shape[1])
    is_earlier = (time[:, None] > time[None])[None]
    is_same = identity[:, :, None] == identity[:, None]
    return 1.0 - jnp.any(is_same & is_earlier, axis=2).astype(jnp.float32)
