"""Settings that hold for every test, made before any of them touches JAX."""

import atexit
import os
import re
import shutil
import tempfile
from pathlib import Path

import jax
import pytest

FOLDER = "JAX_COMPILATION_CACHE_DIR"
if "PYTEST_XDIST_WORKER" not in os.environ:
    # Equal programs compile once for all workers, and for the processes that tests start. A
    # cache left by another version of the code must not decide what is tested.
    os.environ[FOLDER] = tempfile.mkdtemp(prefix="trap_tube_jax-tests-")
    atexit.register(shutil.rmtree, os.environ[FOLDER], ignore_errors=True)

SETTINGS = {
    "jax_compilation_cache_dir": os.environ[FOLDER],
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
    # An accidental broadcast between ranks is a bug that a shape test may not see.
    "jax_numpy_rank_promotion": "raise",
}


def set_for_all_processes(name: str, value: object) -> None:
    """Sets a configuration of JAX here and in the processes that tests start."""
    os.environ[name.upper()] = str(value)
    jax.config.update(name, value)


for setting in SETTINGS.items():
    set_for_all_processes(*setting)


@pytest.fixture(scope="module", autouse=True)
def _optimisation(request: pytest.FixtureRequest) -> None:
    """Agents take longer to compile than to run here; the rules run in millions of states.

    A module of agents that run for long says OPTIMISED.
    """
    is_of_agents = re.search(r"^(from|import) agents\b", Path(request.path).read_text(), re.M)
    optimised = is_of_agents is None or hasattr(request.module, "OPTIMISED")
    set_for_all_processes("jax_disable_most_optimizations", not optimised)
