"""The suite once more under settings that users have: slow."""

import os
import subprocess
import sys

import pytest

from helpers.paths import ROOT

READ_ONLY = "/proc/self"  # a home in which nobody can write


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"JAX_ENABLE_X64": "1"},
        {"JAX_DEBUG_KEY_REUSE": "1"},
        {"JAX_DEBUG_NANS": "1"},
        {"JAX_DEFAULT_PRNG_IMPL": "rbg"},
        {"PYTHONIOENCODING": "ascii"},
        {"HOME": None},
        {"HOME": READ_ONLY},
    ],
    ids=lambda settings: "-".join(f"{name}={value}" for name, value in settings.items()),
)
def test_the_suite_passes_under_settings_of_users(settings):
    environment = {**os.environ, **settings}
    environment = {name: value for name, value in environment.items() if value is not None}
    for name in ("PYTEST_XDIST_WORKER", "XDG_CACHE_HOME"):  # set by the test suite
        environment.pop(name, None)
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider"]
    done = subprocess.run(
        command, check=False, cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-5000:]
