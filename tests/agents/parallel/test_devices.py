"""Several devices: they share the episodes, or are refused."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from agents.config import Config
from agents.parallel.devices import ONE_DEVICE, Placement
from helpers.paths import ROOT


@pytest.fixture
def twelve_devices(monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 12)
    monkeypatch.setattr(jax, "devices", lambda: 12 * jax.local_devices())


@pytest.mark.parametrize(("devices", "size"), [(None, 1), (1, 1), (4, 4), (8, 8)])
def test_devices_share_the_episodes(twelve_devices, devices, size):
    config = Config(episodes_per_iteration=56, minibatch_size=8)
    placement = Placement.of(devices, config)
    assert (placement.mesh is None) == (size == 1)
    assert placement.axis.size == size


@pytest.mark.parametrize("devices", [12, 5, 0])
def test_devices_that_do_not_divide_the_minibatch_are_refused(twelve_devices, devices):
    config = Config(episodes_per_iteration=16, minibatch_size=8)
    with pytest.raises(ValueError, match=f"^{devices} of 12 cpu devices .* allowed: 1, 2, 4, 8$"):
        Placement.of(devices, config)


def test_one_device_needs_no_mesh_and_leaves_arrays_as_they_are():
    alone = Placement()
    x = jnp.arange(3)
    assert alone.shard(print) is print
    assert alone.put(x) is alone.local(x) is x
    for method in (ONE_DEVICE.mean, ONE_DEVICE.part, ONE_DEVICE.gather, ONE_DEVICE.device_key):
        assert method(x) is x
    assert str(alone) == "cpu"


@pytest.mark.slow
def test_two_devices_train_as_one():
    """By what `sharded_training` finds on two simulated devices."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_NUM_CPU_DEVICES"}
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-W", "error", ROOT / "tests" / "helpers" / "sharded_training.py"],
        env={**environment, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    two = json.loads(done.stdout)
    assert two["unequal_copies"] == []
    assert two["same_shapes"]
    assert two["same_metrics"]
    assert two["iteration"] == 3
    assert two["transitions"] == two["steps_played"] > 0
    assert two["gradient_gap"] < 1e-5  # of the mean of two halves and the whole
    assert two["shared_rows"] == [list(range(6)), 2]
    assert two["seed_devices"] == 2
    assert two["seeds_gap"] < 1e-5  # between a seed on the first device and on the second
