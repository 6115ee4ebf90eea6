"""The optimizer: Adam as the baseline has it, and the cooldown of its step size."""

import jax.numpy as jnp
import numpy as np
import pytest

from agents import Config
from agents.ppo.optimizer import adam, learning_rate_schedule


@pytest.mark.parametrize(
    ("cooldown", "shares"),
    [
        (0.0, {0: 1, 40: 1}),
        (0.3, {0: 1, 28: 1, 29: 50 ** (-1 / 12), 34: 50**-0.5, 40: 0.02}),
        (1.0, {0: 1, 20: 50**-0.5, 40: 0.02}),
    ],
)
def test_the_cooldown_counts_gradient_steps(cooldown, shares):
    config = Config(
        iterations=10,
        epochs=2,
        episodes_per_iteration=8,
        minibatch_size=4,
        lr_decay_fraction=cooldown,
        learning_rate=0.5,
    )
    assert config.gradient_steps == 4
    schedule = learning_rate_schedule(config)
    for count, share in shares.items():
        np.testing.assert_allclose(schedule(jnp.int32(count)), 0.5 * share, rtol=1e-5)


def test_the_cooldown_takes_the_nearest_number_of_steps():
    """0.29 * 100 is 28.999... in floating point."""
    config = Config(iterations=25, epochs=4, minibatch_size=1024, lr_decay_fraction=0.29)
    schedule = learning_rate_schedule(config)
    found = np.array([schedule(jnp.int32(count)) for count in (71, 72)])
    np.testing.assert_allclose(found / config.learning_rate, [1, 50 ** (-1 / 29)], rtol=1e-5)


def test_adam_takes_the_learning_rate_schedule_of_its_count():
    """With a constant gradient each step is as long as the schedule says."""
    optimizer = adam(lambda count: jnp.where(jnp.equal(count, 0), 0.1, 0.01), epsilon=0.0)
    params = jnp.zeros(3)
    state = optimizer.init(params)
    steps = []
    for _ in range(2):
        step, state = optimizer.update(jnp.full(3, 2.0), state, params)
        steps.append(step)
    np.testing.assert_allclose(steps, np.outer([-0.1, -0.01], np.ones(3)), rtol=1e-4)
