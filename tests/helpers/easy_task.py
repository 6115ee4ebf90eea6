"""A task that random actions solve soon."""

import jax.numpy as jnp

import trap_tube_jax as tt

EASY = tt.State.from_ascii(["TA.F........", *["." * 12] * 11])
RIGHT = jnp.array((3, 3))
DOWN = jnp.array((3, 1))
