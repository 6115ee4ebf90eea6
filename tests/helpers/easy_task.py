"""Small tasks."""

import jax.numpy as jnp

import trap_tube_jax as tt

# The agent must push the food out of its cell through the exit.
WORKSHOP = tt.State.from_ascii(
    [
        "222222222222",
        "2.....222222",
        "2.A.T..e.e.2",
        "2...TFx22222",
        "2......22222",
        *["222222222222"] * 7,
    ]
)
# Random actions solve it soon.
EASY = tt.State.from_ascii(["TA.F........", *["." * 12] * 11])
RIGHT = jnp.array((3, 3))
DOWN = jnp.array((3, 1))
