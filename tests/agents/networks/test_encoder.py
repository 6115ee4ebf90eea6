"""The paper's encoder by distinct windows against the plain one."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.networks import chunks
from agents.networks.convolution import convolve
from agents.networks.encoder import Encoder
from agents.networks.grouping import group_rows
from agents.networks.layers import Deviation, draw
from agents.networks.windows import cut_into_windows, encode_by_windows

EPISODES, STEPS = 3, 6
encoder = Encoder((4, 6))


def boards(env_id: str, num_features: int) -> jax.Array:
    """What random play sees, u8[M, 12, 12, N]."""
    env = tt.make(env_id, num_features=num_features)
    keys = jax.random.split(jax.random.key(1), EPISODES)
    actions = jax.random.randint(jax.random.key(2), (STEPS, EPISODES, 2), 0, 4)

    def step(state: tt.State, action: jax.Array) -> tuple[tt.State, jax.Array]:
        state, timestep = jax.vmap(env.step)(state, action)
        return state, timestep.observation

    state, _ = jax.vmap(env.reset)(keys)
    _, observations = jax.lax.scan(step, state, actions)
    return observations.reshape(-1, *observations.shape[2:])


SETS = [
    ("base", 3),
    ("pstsy", 3),
    ("pst", 5),
    pytest.param(("pstsy", 1), marks=pytest.mark.slow),
]


@pytest.fixture(scope="module", params=SETS)
def observation(request: pytest.FixtureRequest) -> jax.Array:
    return jax.jit(boards, static_argnums=(0, 1))(*request.param)


@jax.jit
def parameters(observation: jax.Array) -> Any:
    deviations = encoder.init(jax.random.key(0), observation[:1])
    # Biases too: what lies beyond the edge is zero only because nothing is added to it.
    deviations = jax.tree.map(
        lambda leaf: leaf if leaf.ndim > 1 else Deviation(leaf + 0.1), deviations
    )
    return draw(jax.random.key(3), deviations)


def features_and_gradient(function: Any) -> Any:
    """Those of a function of (parameters, observations); the gradient of its sine's sum."""

    def total(params: Any, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        features = function(params, observation)
        return jnp.sum(jnp.sin(features)), features

    return jax.jit(jax.grad(total, has_aux=True))


plain = features_and_gradient(encoder.apply)


def by_windows(params: Any, observation: jax.Array) -> Any:
    return chunks.map_rows(encode_by_windows, 4, params, observation, jnp.int32(len(observation)))


# Nothing is remembered for the derivative, or all; compiled once for all task sets.
BY_WINDOWS = {size: features_and_gradient(functools.partial(by_windows)) for size in (0, 2**20)}


@pytest.mark.parametrize("remembered_bytes", BY_WINDOWS)
def test_windows_give_the_plain_features_and_gradient(observation, remembered_bytes, monkeypatch):
    monkeypatch.setattr(chunks, "REMEMBERED_BYTES", remembered_bytes)
    params = parameters(observation)
    gradient, features = BY_WINDOWS[remembered_bytes](params, observation)
    want, expected = plain(params, observation)
    np.testing.assert_allclose(features, expected, rtol=1e-5, atol=1e-5)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), gradient, want
    )
    assert all(np.abs(leaf).max() > 1e-2 for leaf in jax.tree.leaves(want))


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_convolution_and_its_derivatives_are_those_of_jax(size):
    keys = jax.random.split(jax.random.key(size), 3)
    x, cotangent = (
        jax.random.normal(keys[0], (2, 6, 4, 3)),
        jax.random.normal(keys[1], (2, 6, 4, 5)),
    )
    kernel = jax.random.normal(keys[2], (size, size, 3, 5))

    def reference(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return jax.lax.conv_general_dilated(
            x,
            kernel,
            (1, 1),
            "SAME",
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision="highest",
        )

    def derived(function: Any) -> Any:
        value, pullback = jax.vjp(function, x, kernel)
        return value, pullback(cotangent)

    (got, pulled), (want, expected) = jax.jit(lambda: (derived(convolve), derived(reference)))()
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)
    for ours, theirs in zip(pulled, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_windows_are_the_parts_of_the_board():
    observation = jax.random.randint(jax.random.key(0), (2, 12, 12, 3), 0, 256).astype(jnp.uint8)
    window, block = cut_into_windows(observation)
    padded = np.pad(observation, ((0, 0), (0, 2), (0, 2), (0, 0)))
    for index in range(72):
        row, column = divmod(int(block[index]), 6)
        assert (row * 6 + column) == index % 36
        part = padded[index // 36, 2 * row : 2 * row + 4, 2 * column : 2 * column + 4]
        np.testing.assert_array_equal(window[index].reshape(4, 4, 3), part)


def test_few_windows_of_an_episode_are_distinct():
    window, block = cut_into_windows(jax.jit(boards, static_argnums=(0, 1))("base", 3))
    groups = group_rows(jnp.concatenate([window, block[:, None]], axis=1))
    assert 36 < groups.total < len(window) / 5
    np.testing.assert_array_equal(window[groups.representative[groups.number]], window)
    np.testing.assert_array_equal(block[groups.representative[groups.number]], block)
