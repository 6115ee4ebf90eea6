"""Distributions of actions against float64 NumPy on random cases, and the clipped objective."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.networks.actions import ActionDistribution
from agents.ppo import losses

CASES = 1_000
CHOICES = 4


@pytest.fixture(scope="module")
def cases() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "logits": rng.normal(0, 3, (CASES, CHOICES)).astype(np.float32),
        "choice": rng.integers(0, CHOICES, CASES).astype(np.int32),
    }


def softmax(logits: np.ndarray) -> np.ndarray:
    exponentials = np.exp(logits.astype(np.float64))
    return exponentials / exponentials.sum(-1, keepdims=True)


def distribution(logits: jax.Array) -> ActionDistribution:
    """Grasp by these logits, move by the same in reverse order."""
    return ActionDistribution(jnp.stack([logits, logits[..., ::-1]], axis=-2))


def test_log_prob_and_entropy_of_actions(cases):
    probs = softmax(cases["logits"])
    everyone = np.arange(CASES)
    grasp = cases["choice"]
    move = np.roll(cases["choice"], 1)
    actions = distribution(jnp.asarray(cases["logits"]))
    expected = np.log(probs[everyone, grasp]) + np.log(probs[everyone, CHOICES - 1 - move])
    result = actions.log_prob(jnp.stack([grasp, move], axis=-1))
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-5)
    expected = -2 * (probs * np.log(probs)).sum(-1)
    np.testing.assert_allclose(actions.entropy(), expected, rtol=1e-4, atol=1e-5)


def test_mode_is_the_most_probable_action(cases):
    mode = distribution(jnp.asarray(cases["logits"])).mode()
    best = cases["logits"].argmax(-1)
    np.testing.assert_array_equal(mode, np.stack([best, CHOICES - 1 - best], axis=-1))


def test_samples_have_the_joint_frequencies():
    logits = jnp.broadcast_to(jnp.log(jnp.array([0.1, 0.2, 0.3, 0.4])), (20_000, CHOICES))
    action = distribution(logits).sample(jax.random.key(0))
    counts = np.zeros((CHOICES, CHOICES))
    np.add.at(counts, tuple(np.asarray(action).T), 1 / len(action))
    expected = np.outer([0.1, 0.2, 0.3, 0.4], [0.4, 0.3, 0.2, 0.1])
    np.testing.assert_allclose(counts, expected, atol=0.01)


def test_entropy_of_certainty_is_zero_and_its_gradient_finite():
    logits = jnp.array([0.0, -1e4, -1e4, -1e4])
    value, gradient = jax.value_and_grad(lambda x: distribution(x).entropy())(logits)
    assert value == 0
    assert np.all(np.isfinite(gradient))


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


def test_padding_counts_as_zeros_in_means():
    x = jnp.array([[1.0, 2.0], [4.0, 100.0]])
    mask = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    assert losses.padded_mean(x, mask) == 7 / 4
