"""The loss that predicts motion, on steps that are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents import Config, make_train
from agents.ppo.motion import motion_loss
from small_runs import SETTINGS

# The agent moves down, the food right; the tool stays.
CELLS = jnp.array([[[[3, 3], [5, 5], [7, 7]]], [[[4, 3], [5, 5], [7, 8]]]], jnp.uint8)


def test_motion_is_a_change_of_row_or_column():
    confident = jnp.array([[[[9.0, -9.0], [-9.0, -9.0], [-9.0, 9.0]]]])
    right, wrong = motion_loss(confident, CELLS), motion_loss(-confident, CELLS)
    np.testing.assert_allclose(motion_loss(0 * confident, CELLS), [[6 * np.log(2)]], rtol=1e-6)
    np.testing.assert_allclose(right, [[6 * np.log1p(np.exp(-9))]], rtol=1e-3)
    np.testing.assert_allclose(wrong - right, [[6 * 9]], rtol=1e-6)


@pytest.mark.parametrize("curiosity", ["none", "icm"])
def test_motion_is_learned_with_any_curiosity(curiosity):
    settings = {**SETTINGS, "curiosity": curiosity, "motion_coef": 1.0, "learning_rate": 0.02}
    learner = make_train(Config(**settings))
    state, found = learner.init(jax.random.key(0)), []
    iterate = jax.jit(learner.iterate)
    for _ in range(4):
        state, metrics = iterate(state)
        found.append(float(metrics["motion_loss"]))
    assert found[-1] < 0.7 * found[0]
