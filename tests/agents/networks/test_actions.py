"""Distributions of actions against float64 NumPy on random cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.networks.actions import ActionDistribution

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


def test_a_penalty_changes_the_most_probable_action():
    logits = jnp.array([[0.0, 4.0, 3.0, 0.0]])
    # Grasp 1, move 2; then move 1.
    actions = ActionDistribution(jnp.stack([logits, logits[:, ::-1]], axis=1))
    penalty = jnp.zeros((1, 4, 4))
    assert actions.mode(penalty).tolist() == actions.mode().tolist() == [[1, 2]]
    penalty = penalty.at[0, 1, 2].set(0.9)
    assert actions.mode(penalty).tolist() == [[1, 2]]
    penalty = penalty.at[0, 1, 2].set(1.1)
    assert actions.mode(penalty).tolist() == [[1, 1]], "the lower index of two equal ones"


@pytest.mark.parametrize("leading", [(), (2, 3)])
def test_a_distribution_may_have_any_leading_axes(leading):
    """Grasp 1 and move 3 are most probable; a penalty of both leaves grasp 2 and move 3."""
    logits = np.full((*leading, 2, 4), -1e3, np.float32)
    logits[..., 0, 1] = logits[..., 1, 3] = 0
    logits[..., 0, 2] = -50

    @jax.jit
    def found(logits, penalty):
        actions = ActionDistribution(logits)
        uniform = ActionDistribution(jnp.zeros_like(logits))
        drawn = actions.sample(jax.random.key(0))
        numbers = uniform.entropy(), -uniform.log_prob(drawn)
        return (drawn, actions.mode(), actions.mode(penalty)), numbers

    penalty = np.zeros((*leading, 4, 4), np.float32)
    penalty[..., 1, 3] = 99
    actions, numbers = found(logits, penalty)
    for action, expected in zip(actions, ([1, 3], [1, 3], [2, 3]), strict=True):
        np.testing.assert_array_equal(action, np.broadcast_to(expected, (*leading, 2)))
    for number in numbers:
        np.testing.assert_allclose(number, np.full(leading, 2 * np.log(4)), rtol=1e-6)
