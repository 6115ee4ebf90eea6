"""The terms of the loss against float64 NumPy, on random cases with masks."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents.acting.episodes import Episodes
from agents.config import Config
from agents.curiosity import Experience
from agents.curiosity.icm import ICM
from agents.networks.actions import ActionDistribution
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


def distribution(logits: jax.Array) -> ActionDistribution:
    """Grasp by these logits, move by the same in reverse order."""
    return ActionDistribution(logits, logits[..., ::-1])


def test_log_prob_and_entropy_of_actions(cases):
    probs, everyone = softmax(cases["logits"]), np.arange(CASES)
    grasp, move = cases["choice"], np.roll(cases["choice"], 1)
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


def test_clipped_surrogate(cases):
    clip = 0.2
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


def test_padded_mean_divides_by_all_steps(cases):
    result = losses.padded_mean(jnp.asarray(cases["new"]), jnp.asarray(cases["mask"]))
    expected = (cases["new"].astype(np.float64) * cases["mask"]).sum() / CASES
    np.testing.assert_allclose(result, expected, rtol=1e-5)


def test_icm_is_the_forward_error_and_the_inverse_likelihood():
    """The curiosity's arrays against a NumPy reading of its equations."""
    rng = np.random.default_rng(2)
    config = Config(hidden=6, embedding=2)
    embedding, next_embedding = rng.normal(size=(2, 1, CASES, 6)).astype(np.float32)
    action_embedding = rng.normal(size=(1, CASES, 4)).astype(np.float32)
    action = rng.integers(0, CHOICES, (1, CASES, 2))
    nothing: Any = None
    episodes = Episodes(nothing, nothing, jnp.asarray(action), *[nothing] * 4)
    experience = Experience(
        episodes, nothing, *map(jnp.asarray, (embedding, next_embedding, action_embedding))
    )
    icm = ICM(config)
    params = icm.init(jax.random.key(0), nothing)

    weights = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)
    forward = weights["forward"]["params"]["Dense_0"]
    both = np.concatenate([embedding, action_embedding], -1)
    error = embedding + both @ forward["kernel"] + forward["bias"] - next_embedding
    reward, memory = icm.reward(params, (), experience)
    found = icm.losses(params, experience)
    assert memory == ()
    np.testing.assert_allclose(reward, (error**2).sum(-1), rtol=1e-4)
    np.testing.assert_allclose(found["forward_loss"], (error**2).mean(-1), rtol=1e-4)

    inverse = weights["inverse"]["params"]
    both = np.concatenate([embedding, next_embedding], -1)
    x = both @ inverse["Dense_0"]["kernel"] + inverse["Dense_0"]["bias"]
    x = x / (1 + np.exp(-x))
    expected = np.zeros((1, CASES))
    for part, name in enumerate(("grasp", "move")):
        probs = softmax(x @ inverse[name]["kernel"] + inverse[name]["bias"])
        expected -= np.log(np.take_along_axis(probs, action[..., part, None], -1)[..., 0])
    np.testing.assert_allclose(found["inverse_loss"], expected, rtol=1e-4, atol=1e-5)
