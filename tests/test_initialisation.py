"""How parameters are drawn."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from agents.networks.layers import Deviation, dense, draw, init_module, output_dense


def test_weights_have_the_variance_of_their_layer_and_biases_are_zero():
    for layer, scale in ((dense(300), 2.0), (output_dense(300), 1.0)):
        params = init_module(layer, jax.random.key(0), jnp.zeros((1, 200)))["params"]
        deviation = np.sqrt(scale / 200)
        np.testing.assert_allclose(np.std(params["kernel"]), deviation, rtol=0.02)
        assert np.abs(params["kernel"]).max() < 2 * deviation / 0.879
        np.testing.assert_array_equal(params["bias"], 0)


def test_parameters_of_the_same_shape_differ():
    one, other = draw(jax.random.key(0), [Deviation(jnp.ones(9)), Deviation(jnp.ones(9))])
    assert not np.any(np.isclose(one, other))


def test_layers_of_flax_start_as_flax_has_it():
    mixed = nn.Sequential([dense(4), nn.LayerNorm(), nn.Dense(4)])
    keys = jax.random.split(jax.random.key(0))
    one, other = (init_module(mixed, key, jnp.ones((1, 3)))["params"] for key in keys)
    np.testing.assert_array_equal(one["layers_1"]["scale"], 1)
    assert not np.any(np.isclose(one["layers_2"]["kernel"], other["layers_2"]["kernel"]))
    own: Any = nn.Dense(4).init(keys[0], jnp.ones((1, 4)))["params"]["kernel"]
    np.testing.assert_allclose(np.std(one["layers_2"]["kernel"]), np.std(own), rtol=0.5)
