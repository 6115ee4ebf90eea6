"""A CPU's cores as devices: how many appear, and how many share a run."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from agents import Config
from agents.parallel import cores
from agents.parallel.sharding import Placement

PROGRAM = """
import sys
from agents.parallel import cores
cores.available_cores = lambda: list(range(6))
cores.become_devices(eval(sys.argv[1]))
import jax
print(jax.device_count())
"""


@pytest.fixture
def eight_devices(monkeypatch):
    monkeypatch.setattr(jax, "devices", lambda: 8 * jax.local_devices())
    monkeypatch.setattr(jax, "local_device_count", lambda: 8)


@pytest.mark.parametrize(
    ("wanted", "given", "devices"),
    [(None, "-1", 4), (2, "-1", 2), (9, "-1", 6), (0, "-1", 1), ("all", "-1", 6), (2, "3", 3)],
)
def test_a_cpu_appears_as_devices(wanted, given, devices):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, repr(wanted)],
        env={**os.environ, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": given},
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(done.stdout) == devices


def test_all_cores_are_numbered():
    assert 1 <= len(cores.available_cores()) <= (os.cpu_count() or 1)


@pytest.mark.parametrize(("minibatch", "devices"), [(8, 8), (12, 6), (7, 7), (11, 1)])
def test_devices_of_a_cpu_share_what_divides(eight_devices, minibatch, devices):
    config = Config(episodes=minibatch, minibatch=minibatch)
    placement = Placement.of(None, config, seeds=1)
    assert (1 if placement.mesh is None else placement.mesh.size) == devices


def test_other_devices_are_shared_on_request_only(eight_devices, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert Placement.of(None, Config(), seeds=1) == Placement()
