"""Several devices: they share seeds and episodes, or are refused."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from agents.config import Config
from agents.parallel.devices import ONE_DEVICE, Placement
from paths import ROOT
from settings import IS_THREEFRY


@pytest.fixture
def twelve_devices(monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 12)
    monkeypatch.setattr(jax, "devices", lambda: 12 * jax.local_devices())


@pytest.mark.parametrize(
    ("devices", "minibatch_size", "seeds", "shape"),
    [
        (None, 8, 1, None),
        (1, 8, 3, None),
        (4, 8, 1, {"seeds": 1, "episodes": 4}),
        (4, 8, 2, {"seeds": 2, "episodes": 2}),
        (12, 8, 3, {"seeds": 3, "episodes": 4}),
        (3, 7, 6, {"seeds": 3, "episodes": 1}),
    ],
)
def test_seeds_are_spread_first_and_then_episodes(
    twelve_devices, devices, minibatch_size, seeds, shape
):
    config = Config(episodes_per_iteration=56, minibatch_size=minibatch_size)
    placement = Placement.of(devices, config, seeds)
    assert (placement.mesh and dict(placement.mesh.shape)) == shape
    assert placement.axis.size == (shape["episodes"] if shape else 1)


@pytest.mark.parametrize(
    ("devices", "seeds", "allowed"),
    [(12, 1, "1, 2, 4, 8"), (5, 3, "1, 2, 3, 4, 6, 8, 12"), (0, 1, "1, 2, 4, 8")],
)
def test_devices_that_do_not_divide_the_minibatch_are_refused(
    twelve_devices, devices, seeds, allowed
):
    config = Config(episodes_per_iteration=16, minibatch_size=8)
    with pytest.raises(ValueError, match=f"^{devices} of 12 cpu devices .* allowed: {allowed}$"):
        Placement.of(devices, config, seeds)


def test_one_device_computes_as_it_is_told():
    alone, x = Placement(), jnp.arange(3)
    assert alone.shard(print) is print
    assert alone.put(x) is alone.local(x) is x
    for method in (ONE_DEVICE.mean, ONE_DEVICE.part, ONE_DEVICE.gather, ONE_DEVICE.own_key):
        assert method(x) is x
    assert str(alone) == "cpu"


def test_two_devices_train_as_one():
    """By what `sharded_training` finds on two simulated devices."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_NUM_CPU_DEVICES"}
    done = subprocess.run(
        [sys.executable, "-W", "error", ROOT / "tests" / "sharded_training.py"],
        env={**environment, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    two = json.loads(done.stdout)
    assert two["unequal_copies"] == two["different_shapes"] == two["different_metrics"] == []
    assert two["iteration"] == 3
    assert two["is_finite"] == [1, 1, 1]
    assert two["transitions"] == two["steps_played"] > 0
    assert two["gradient_gap"] < 1e-5  # of the mean of two halves and the whole
    if IS_THREEFRY:  # draws of rbg keys depend on jax.vmap
        assert two["seeds_gap"] < 1e-5  # of a seed on each device and both on one
