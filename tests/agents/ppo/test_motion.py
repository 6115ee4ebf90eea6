"""The loss that predicts motion, on steps that are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from agents.networks.layers import init_module
from agents.ppo.motion import MotionHead, motion_loss

# The agent moves down, the food right, and the tool stays; then nothing moves.
AFTER = [[4, 3], [5, 5], [7, 8]]
CELLS = jnp.array([[[[3, 3], [5, 5], [7, 7]], AFTER, AFTER]], jnp.uint8)


def test_the_motion_loss_is_a_cross_entropy_of_changed_rows_and_columns():
    moving = [[9.0, -9.0], [-9.0, -9.0], [-9.0, 9.0]]
    confident = jnp.array([[moving, [[-9.0, -9.0]] * 3]])
    right = motion_loss(confident, CELLS)
    wrong = motion_loss(-confident, CELLS)
    np.testing.assert_allclose(motion_loss(0 * confident, CELLS), [[6 * np.log(2)] * 2], rtol=1e-6)
    np.testing.assert_allclose(right, [[6 * np.log1p(np.exp(-9))] * 2], rtol=1e-3)
    np.testing.assert_allclose(wrong - right, [[6 * 9] * 2], rtol=1e-6)


def test_the_head_reads_embedding_and_action_of_a_step():
    embedding = jnp.ones((2, 4, 5))
    action = jnp.ones((2, 4, 3))
    head: Any = MotionHead()
    params = init_module(head, jax.random.key(0), embedding, action)
    logits = head.apply(params, embedding, action)
    assert logits.shape == (2, 4, 3, 2)
    for changed in ((embedding.at[1, 2, 0].set(2), action), (embedding, action.at[1, 2, 0].set(2))):
        differs = np.asarray(head.apply(params, *changed) != logits).any(axis=(2, 3))
        assert np.argwhere(differs).tolist() == [[1, 2]]
