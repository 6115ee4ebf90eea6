"""The loss that predicts motion, on steps that are known."""

import jax.numpy as jnp
import numpy as np

from agents.ppo.motion import motion_loss

# The agent moves down, the food right; the tool stays.
CELLS = jnp.array([[[[3, 3], [5, 5], [7, 7]], [[4, 3], [5, 5], [7, 8]]]], jnp.uint8)


def test_motion_is_a_change_of_row_or_column():
    confident = jnp.array([[[[9.0, -9.0], [-9.0, -9.0], [-9.0, 9.0]]]])
    right, wrong = motion_loss(confident, CELLS), motion_loss(-confident, CELLS)
    np.testing.assert_allclose(motion_loss(0 * confident, CELLS), [[6 * np.log(2)]], rtol=1e-6)
    np.testing.assert_allclose(right, [[6 * np.log1p(np.exp(-9))]], rtol=1e-3)
    np.testing.assert_allclose(wrong - right, [[6 * 9]], rtol=1e-6)
