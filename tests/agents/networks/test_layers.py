"""Initial parameters: their scale, their independence, and layers of Flax among them."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from agents import Config
from agents.curiosity.icm import Models
from agents.networks import make_encoder
from agents.networks.core import Core, Heads
from agents.networks.layers import Undrawn, dense, draw, init_module, output_dense


def test_kernels_have_the_variance_of_their_layer_and_biases_are_zero():
    for layer, scale in ((dense(300), 2.0), (output_dense(300), 1.0)):
        params = init_module(layer, jax.random.key(0), jnp.zeros((1, 200)))["params"]
        std = np.sqrt(scale / 200)
        np.testing.assert_allclose(np.std(params["kernel"]), std, rtol=0.02)
        assert np.abs(params["kernel"]).max() < 2 * std / 0.879
        np.testing.assert_array_equal(params["bias"], 0)


def scales(module: nn.Module, *inputs: Any) -> dict[str, float]:
    """Returns a parameter's standard deviation times the root of its fan-in, by its path."""
    found = {}
    params = nn.meta.unbox(jax.jit(module.init)(jax.random.key(0), *inputs))["params"]
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        (scale,) = set(np.ravel(leaf * np.sqrt(np.prod(leaf.shape[:-1]))).tolist())
        found["/".join(part.key for part in path)] = round(float(scale), 4)
    return found


def test_every_layer_has_the_scale_of_the_table_in_agent_md():
    h = jnp.zeros((1, 64))
    a = jnp.zeros((1, 16))
    board = jnp.zeros((1, 12, 12, 3), jnp.uint8)
    core = scales(Core(64, 8), h, h, jnp.zeros((1, 2), jnp.int32), jnp.zeros(1))
    encoder = scales(make_encoder(Config()), board)
    icm = scales(Models(64), h, h, a)
    heads = scales(Heads(), h)
    biases = ("bias", "initial")
    for part in (core, encoder, icm, heads):
        for name in [name for name in part if name.endswith(biases)]:
            assert part.pop(name) == 0
    assert set(core.values()) == set(encoder.values()) == {1.4142}
    assert set(heads.values()) == {1}
    assert list(icm.values()) == [1, 1.4142, 1, 1]  # forward, inverse and its heads


def test_parameters_of_the_same_shape_differ():
    kernels = [Undrawn(jnp.ones(9, jnp.float32)) for _ in range(2)]
    one, other = draw(jax.random.key(0), kernels)
    assert not np.any(np.isclose(one, other))


def test_layers_of_flax_start_as_flax_initialises_them():
    mixed = nn.Sequential([dense(4), nn.LayerNorm(), nn.Dense(4)])
    keys = jax.random.split(jax.random.key(0))
    one, other = (init_module(mixed, key, jnp.ones((1, 3)))["params"] for key in keys)
    np.testing.assert_array_equal(one["layers_1"]["scale"], 1)
    assert not np.any(np.isclose(one["layers_2"]["kernel"], other["layers_2"]["kernel"]))
    flax_dense: Any = nn.Dense(4).init(keys[0], jnp.ones((1, 4)))["params"]["kernel"]
    np.testing.assert_allclose(np.std(one["layers_2"]["kernel"]), np.std(flax_dense), rtol=0.5)


class Own(nn.Module):
    """A parameter of NumPy numbers beside a layer of ours."""

    @nn.compact
    def __call__(self, x):
        scale: Any = self.param("scale", lambda key: np.ones(4, np.float32))
        return dense(4)(x) * scale.reshape(1, -1)


@pytest.mark.parametrize("module", [Own(), nn.remat(Own)()])
def test_only_kernels_of_our_layers_are_drawn_in_any_module(module):
    params = init_module(module, jax.random.key(0), jnp.ones((1, 3)))["params"]
    np.testing.assert_array_equal(params["scale"], 1)
    assert len(np.unique(params["Dense_0"]["kernel"])) == 12


def test_a_module_may_have_no_parameters():
    assert init_module(nn.Sequential([jnp.tanh]), jax.random.key(0), jnp.ones((1, 3))) == {}
