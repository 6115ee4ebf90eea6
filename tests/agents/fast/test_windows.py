"""The paper's encoder by distinct windows against the plain one."""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trap_tube_jax as tt
from agents.fast import chunks, convolution
from agents.fast.convolution import convolutions_as_products, convolve
from agents.fast.windows import encode_rows
from agents.networks.encoder import Encoder
from agents.networks.layers import Conv, init_module

EPISODES = 3
STEPS = 6
encoder = Encoder((4, 6))


def boards(env_id: str, num_features: int) -> jax.Array:
    """Plays at random; returns the observations u8[M, 12, 12, N]."""
    env = tt.make(env_id, num_features=num_features)
    keys = jax.random.split(jax.random.key(1), EPISODES)
    actions = jax.random.randint(jax.random.key(2), (STEPS, EPISODES, 2), 0, 4)

    def step(state: tt.State, action: jax.Array) -> tuple[tt.State, jax.Array]:
        state, timestep = jax.vmap(env.step)(state, action)
        return state, timestep.observation

    state, _ = jax.vmap(env.reset)(keys)
    _, observations = jax.lax.scan(step, state, actions)
    return observations.reshape(-1, *observations.shape[2:])


SETS = [("base", 3), ("pstsy", 3), ("pst", 5), pytest.param(("pstsy", 1), marks=pytest.mark.slow)]


@pytest.fixture(scope="module", params=SETS)
def observation(request: pytest.FixtureRequest) -> jax.Array:
    return jax.jit(boards, static_argnums=(0, 1))(*request.param)


@jax.jit
def parameters(observation: jax.Array) -> Any:
    """Draws parameters with biases, so that padding with zeros differs from padding before them."""
    params = init_module(encoder, jax.random.key(3), observation[:1])
    return jax.tree.map(lambda leaf: leaf if leaf.ndim > 1 else leaf + 0.1, params)


def features_and_gradient(function: Any) -> Any:
    """Compiles the features, and the gradient of the sum of their sines."""

    def total(params: Any, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        features = function(params, observation)
        return jnp.sum(jnp.sin(features)), features

    return jax.jit(jax.grad(total, has_aux=True))


plain = features_and_gradient(encoder.apply)


def by_windows(params: Any, observation: jax.Array) -> Any:
    return chunks.map_rows(encode_rows, 4, params, observation, jnp.int32(len(observation)))


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
def test_convolution_and_its_derivatives_equal_jaxs(size):
    shapes = (2, 6, 4, 3), (2, 6, 4, 5), (size, size, 3, 5)
    keys = jax.random.split(jax.random.key(size), 3)
    x, cotangent, kernel = map(jax.random.normal, keys, shapes)

    def reference(x: jax.Array, kernel: jax.Array) -> jax.Array:
        layout = ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(
            x, kernel, (1, 1), "SAME", dimension_numbers=layout, precision="highest"
        )

    def derived(function: Any) -> Any:
        value, pullback = jax.vjp(function, x, kernel)
        return value, pullback(cotangent)

    (got, pulled), (want, expected) = jax.jit(lambda: (derived(convolve), derived(reference)))()
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)
    for ours, theirs in zip(pulled, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_only_layers_of_the_encoder_convolve_by_products(monkeypatch):
    x = jax.random.normal(jax.random.key(0), (2, 6, 6, 3))
    ours: Any = Conv(4, 3)
    other: Any = nn.Conv(4, (3, 3), padding="VALID")
    params, other_params = (init_module(layer, jax.random.key(1), x) for layer in (ours, other))
    plain = ours.apply(params, x)
    with convolutions_as_products():
        np.testing.assert_allclose(ours.apply(params, x), plain, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(ours.apply(params, x=x), plain, rtol=1e-4, atol=1e-5)
        monkeypatch.setattr(convolution, "convolve", lambda x, kernel: jnp.full((2, 6, 6, 4), 7.0))
        np.testing.assert_array_equal(ours.apply(params, x), jnp.full((2, 6, 6, 4), 7.0))
        found = other.apply(other_params, x)
    np.testing.assert_array_equal(ours.apply(params, x), plain)
    np.testing.assert_array_equal(found, other.apply(other_params, x))
