"""How parameters are drawn."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from agents import Config
from agents.curiosity.models import ForwardModel, InverseModel
from agents.networks import make_encoder
from agents.networks.core import Core, Heads
from agents.networks.layers import Deviation, dense, draw, init_module, output_dense


def test_weights_have_the_variance_of_their_layer_and_biases_are_zero():
    for layer, scale in ((dense(300), 2.0), (output_dense(300), 1.0)):
        params = init_module(layer, jax.random.key(0), jnp.zeros((1, 200)))["params"]
        deviation = np.sqrt(scale / 200)
        np.testing.assert_allclose(np.std(params["kernel"]), deviation, rtol=0.02)
        assert np.abs(params["kernel"]).max() < 2 * deviation / 0.879
        np.testing.assert_array_equal(params["bias"], 0)


def deviations(module, *inputs, **options):
    """Of every parameter, by path: deviation times root of the fan-in; 0 where it begins at 0."""
    drawn = module.init(jax.random.key(0), *inputs, **options)["params"]
    is_deviation = lambda leaf: isinstance(leaf, Deviation)  # noqa: E731
    found = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(drawn, is_leaf=is_deviation):
        value = np.asarray(leaf.value if is_deviation(leaf) else leaf)
        (scale,) = set((value * np.sqrt(np.prod(value.shape[:-1]))).ravel().tolist()) or {0}
        found["/".join(part.key for part in path)] = round(float(scale), 4)
    return found


def test_every_layer_begins_with_its_own_deviation():
    """The root of s in agents/agent.md, "Network"."""
    config = Config()
    h, a = jnp.zeros((1, 64)), jnp.zeros((1, 16))
    core = deviations(Core(64, 8), h, h, jnp.zeros((1, 2), jnp.int32), jnp.zeros(1))
    biases = ("bias", "initial", "mix/bias", "reward_embedding/bias")
    assert {core.pop(name) for name in biases} == {0}
    assert set(core.values()) == {1.4142}
    heads = deviations(Heads(), h)
    assert [heads[f"{name}/kernel"] for name in ("grasp", "move", "value")] == [1, 1, 1]
    board = jnp.zeros((1, 12, 12, 3), jnp.uint8)
    encoder = deviations(make_encoder(config), board)
    assert {scale for name, scale in encoder.items() if name.endswith("kernel")} == {1.4142}
    assert deviations(ForwardModel(), h, a)["Dense_0/kernel"] == 1
    inverse = deviations(InverseModel(64), h, h)
    kernels = [inverse[f"{name}/kernel"] for name in ("Dense_0", "grasp", "move")]
    assert kernels == [1.4142, 1, 1]


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
