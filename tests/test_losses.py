"""The terms of the loss against float64 NumPy, on random cases with masks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from agents.curiosity.modules import (
    ICM,
    Prediction,
    Transition,
    forward_loss,
    intrinsic_reward,
)
from agents.ppo import losses

CASES, CHOICES = 1_000, 4


@pytest.fixture(scope="module")
def cases() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "logits": rng.normal(0, 3, (CASES, CHOICES)).astype(np.float32),
        "choice": rng.integers(0, CHOICES, CASES).astype(np.int32),
        "new": rng.normal(-2, 0.5, CASES).astype(np.float32),
        "old": rng.normal(-2, 0.5, CASES).astype(np.float32),
        "advantage": rng.normal(size=CASES).astype(np.float32),
        "mask": rng.integers(0, 2, CASES).astype(np.float32),
    }


def softmax(logits: np.ndarray) -> np.ndarray:
    exponentials = np.exp(logits.astype(np.float64))
    return exponentials / exponentials.sum(-1, keepdims=True)


def test_log_prob_and_entropy(cases):
    probs = softmax(cases["logits"])
    expected = np.log(probs[np.arange(CASES), cases["choice"]])
    result = losses.log_prob(jnp.asarray(cases["logits"]), jnp.asarray(cases["choice"]))
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-5)
    expected = -(probs * np.log(probs)).sum(-1)
    result = losses.entropy(jnp.asarray(cases["logits"]))
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)


def test_entropy_of_certainty_is_zero_and_its_gradient_finite():
    logits = jnp.array([0.0, -1e4, -1e4, -1e4])
    value, gradient = jax.value_and_grad(losses.entropy)(logits)
    assert value == 0
    assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("clip", [0.1, 0.2, 0.5])
def test_clipped_surrogate(cases, clip):
    new, old, advantage = (jnp.asarray(cases[name]) for name in ("new", "old", "advantage"))
    result = losses.clipped_surrogate(new, old, advantage, clip)
    ratio = np.exp(cases["new"].astype(np.float64) - cases["old"])
    clipped = np.minimum(np.maximum(ratio, 1 - clip), 1 + clip)
    expected = -np.minimum(ratio * cases["advantage"], clipped * cases["advantage"])
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("ratio", "advantage", "moves"),
    [(1.5, 1.0, False), (1.5, -1.0, True), (0.5, 1.0, True), (0.5, -1.0, False), (1.1, 1.0, True)],
)
def test_clipping_stops_the_gradient_only_where_it_would_go_further(ratio, advantage, moves):
    gradient = jax.grad(losses.clipped_surrogate)(
        jnp.log(ratio), jnp.float32(0.0), jnp.float32(advantage), 0.2
    )
    assert bool(gradient != 0) == moves


def test_masked_mean_divides_by_all_steps(cases):
    result = losses.masked_mean(jnp.asarray(cases["new"]), jnp.asarray(cases["mask"]))
    expected = (cases["new"].astype(np.float64) * cases["mask"]).sum() / CASES
    np.testing.assert_allclose(result, expected, rtol=1e-5)


@pytest.mark.parametrize("name", ["log_prob", "entropy", "clipped_surrogate", "squared_error"])
def test_gradients_by_finite_differences(cases, name):
    logits, choice = jnp.asarray(cases["logits"][:16]) / 3, jnp.asarray(cases["choice"][:16])
    new, old = jnp.asarray(cases["new"][:16]), jnp.asarray(cases["old"][:16])
    advantage = jnp.asarray(cases["advantage"][:16])
    fun, args = {
        "log_prob": (lambda x: losses.log_prob(x, choice), (logits,)),
        "entropy": (losses.entropy, (logits,)),
        # A wide interval: the kink of the clip has no derivative to compare.
        "clipped_surrogate": (lambda x: losses.clipped_surrogate(x, old, advantage, 9.0), (new,)),
        "squared_error": (losses.squared_error, (new, old)),
    }[name]
    check_grads(fun, args, order=1, modes=["rev"], atol=2e-2, rtol=2e-2)


def test_icm_is_the_forward_error_and_the_inverse_logits():
    """The curiosity's arrays against a NumPy reading of its equations."""
    rng = np.random.default_rng(2)
    units, width = 6, 4
    embedding, next_embedding = rng.normal(size=(2, CASES, units)).astype(np.float32)
    action_embedding = rng.normal(size=(CASES, width)).astype(np.float32)
    action = jnp.zeros((CASES, 2), jnp.int32)
    nothing = jnp.zeros((CASES, 0))
    transition = Transition(
        jnp.asarray(embedding), jnp.asarray(next_embedding), jnp.asarray(action_embedding),
        nothing, nothing, action,
    )  # fmt: skip
    icm = ICM(hidden=5)
    params = icm.init(jax.random.key(0), transition, method="predict")
    prediction = icm.apply(params, transition, method="predict")
    assert isinstance(prediction, Prediction)

    weights = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params["params"])
    forward = weights["forward"]["Dense_0"]
    both = np.concatenate([embedding, action_embedding], -1)
    error = embedding + both @ forward["kernel"] + forward["bias"] - next_embedding
    np.testing.assert_allclose(intrinsic_reward(prediction), (error**2).sum(-1), rtol=1e-4)
    np.testing.assert_allclose(forward_loss(prediction), (error**2).mean(-1), rtol=1e-4)

    inverse = weights["inverse"]
    both = np.concatenate([embedding, next_embedding], -1)
    x = both @ inverse["Dense_0"]["kernel"] + inverse["Dense_0"]["bias"]
    x = x / (1 + np.exp(-x))
    for name, logits in (("grasp", prediction.grasp_logits), ("move", prediction.move_logits)):
        expected = x @ inverse[name]["kernel"] + inverse[name]["bias"]
        np.testing.assert_allclose(np.asarray(logits), expected, rtol=1e-3, atol=1e-4)
