"""A CPU's cores as devices: how many appear, and how many share a run."""

import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import pytest

from agents import Config
from agents.parallel import cores
from agents.parallel.sharding import Placement
from paths import ROOT

PROGRAM = """
from agents.parallel import cores
cores.available_cores = lambda: list(range(6))
cores.become_devices(None)
import jax
print(jax.device_count())
"""


@pytest.fixture
def eight_devices(monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: 8 * jax.local_devices())
    monkeypatch.setattr(jax, "local_device_count", lambda: 8)


def test_a_cpu_appears_as_devices():
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "-1"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout) == 4


@pytest.mark.parametrize(("wanted", "devices"), [(None, 4), (2, 2), (9, 6), (0, 1), ("all", 6)])
def test_as_many_cores_become_devices_as_are_wanted(monkeypatch, wanted, devices):
    made = {}
    config = SimpleNamespace(values={"jax_num_cpu_devices": -1}, update=made.__setitem__)
    monkeypatch.setattr(cores, "jax", SimpleNamespace(config=config))
    monkeypatch.setattr(cores, "available_cores", lambda: list(range(6)))
    cores.become_devices(wanted)
    assert made == {"jax_num_cpu_devices": devices}
    config.values["jax_num_cpu_devices"] = 3  # the user's own choice
    made.clear()
    cores.become_devices(wanted)
    assert not made


def test_all_cores_are_numbered(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {3, 1}, raising=False)
    assert cores.available_cores() == [1, 3]
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    assert cores.available_cores() == [0, 1, 2]


@pytest.mark.parametrize(("minibatch", "devices"), [(8, 8), (12, 6), (7, 7), (11, 1)])
def test_devices_of_a_cpu_share_what_divides(eight_devices, minibatch, devices):
    config = Config(episodes=minibatch, minibatch=minibatch)
    placement = Placement.of(None, config, seeds=1)
    assert (1 if placement.mesh is None else placement.mesh.size) == devices


def test_other_devices_are_shared_on_request_only(eight_devices, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert Placement.of(None, Config(), seeds=1) == Placement()
