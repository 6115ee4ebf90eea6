"""The clipped objective."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.ppo import losses


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected", "moves"),
    [
        (1.5, 2.0, -2.4, False),
        (1.5, -2.0, 3.0, True),
        (0.5, 2.0, -1.0, True),
        (0.5, -2.0, 1.6, False),
        (1.1, 2.0, -2.2, True),
    ],
)
def test_clipping_stops_the_gradient_only_where_it_would_go_further(
    ratio, advantage, expected, moves
):
    log_ratio, old, advantage = map(jnp.float32, (np.log(ratio), 0, advantage))
    surrogate = jax.value_and_grad(losses.clipped_surrogate)
    value, gradient = surrogate(log_ratio, old, advantage, 0.2)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    assert bool(gradient != 0) == moves
