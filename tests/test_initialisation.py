"""How parameters are drawn."""

import jax
import jax.numpy as jnp
import numpy as np

from agents.networks.layers import dense, draw, init_module, output_dense


def test_weights_have_the_variance_of_their_layer_and_biases_are_zero():
    for layer, scale in ((dense(300), 2.0), (output_dense(300), 1.0)):
        params = init_module(layer, jax.random.key(0), jnp.zeros((1, 200)))["params"]
        deviation = np.sqrt(scale / 200)
        np.testing.assert_allclose(np.std(params["kernel"]), deviation, rtol=0.02)
        assert np.abs(params["kernel"]).max() < 2 * deviation / 0.879
        np.testing.assert_array_equal(params["bias"], 0)


def test_parameters_of_the_same_shape_differ():
    one, other = draw(jax.random.key(0), [jnp.ones(9), jnp.ones(9)])
    assert not np.any(np.isclose(one, other))
