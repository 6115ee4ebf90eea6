"""Settings that hold for every test, made before any of them touches JAX."""

import atexit
import os
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

if "PYTEST_XDIST_WORKER" not in os.environ:
    # Equal programs compile once for all workers, and for the command lines that tests start. A
    # cache left by another version of the code must not decide what is tested.
    os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="trap_tube_jax-tests-")
    atexit.register(shutil.rmtree, os.environ["XDG_CACHE_HOME"], ignore_errors=True)
    os.environ["MPLCONFIGDIR"] = os.environ["XDG_CACHE_HOME"]  # no warning of a read-only home

EXAMPLE = "agents.examples.near_food"
SETTINGS = {
    # Where the command lines keep theirs.
    "jax_compilation_cache_dir": str(Path(os.environ["XDG_CACHE_HOME"], "trap_tube_jax", "jax")),
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
    # Tests that run side by side use one core per process.
    "jax_num_cpu_devices": 1,
    # An accidental broadcast between ranks is a bug that a shape test may not see.
    "jax_numpy_rank_promotion": "raise",
}

# A shell starts commands in the background with signals ignored, and processes pass that on.
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
    if signal.getsignal(number) is signal.SIG_IGN:
        is_ctrl_c = number == signal.SIGINT
        signal.signal(number, signal.default_int_handler if is_ctrl_c else signal.SIG_DFL)

if (0, 8) <= jax.__version_info__ < (0, 11):  # a flag that XLA does not know ends the process
    # The older code generator compiles in two thirds of the time.
    FLAGS = (os.environ.get("XLA_FLAGS"), "--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join(filter(None, FLAGS))


def set_for_all_processes(name: str, value: object) -> None:
    """Sets a configuration of JAX here and in the processes that tests start."""
    os.environ[name.upper()] = str(value)
    jax.config.update(name, value)


for setting in SETTINGS.items():
    set_for_all_processes(*setting)


@pytest.fixture(scope="module", autouse=True)
def _compilation(request: pytest.FixtureRequest) -> Iterator[None]:
    """Agents take longer to compile than to run here; the rules run in millions of states.

    A module for which it is otherwise says so by OPTIMISED. Programs are dropped after a module, or
    they would fill the memory of a laptop.
    """
    is_of_agents = re.search(r"^(from|import) agents\b", Path(request.path).read_text(), re.M)
    optimised = getattr(request.module, "OPTIMISED", is_of_agents is None)
    set_for_all_processes("jax_disable_most_optimizations", not optimised)
    yield
    jax.clear_caches()


@pytest.fixture(scope="module")
def plain_path() -> Iterator[None]:
    """Trains without the fast path, which takes longer to compile than it saves in small runs."""
    from agents.acting.encoding import Encoding  # noqa: PLC0415  after the settings above
    from agents.ppo import machine  # noqa: PLC0415

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(machine, "make_encoding", Encoding)
        yield


@pytest.fixture
def fresh_task_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Task sets that a test registers are gone after it, and so is the module of an example's."""
    from trap_tube_jax import registry  # noqa: PLC0415  after the settings above

    monkeypatch.setattr(registry, "_task_sets", dict(registry._task_sets))
    monkeypatch.setitem(sys.modules, EXAMPLE, None)  # or, once imported, it would never register
    monkeypatch.delitem(sys.modules, EXAMPLE)


@pytest.fixture
def fresh_names(fresh_task_sets: None) -> Iterator[None]:
    """Curiosities, encoders and task sets that a test registers are gone after it."""
    from agents import registry  # noqa: PLC0415  after the settings above

    kinds = (registry.curiosities, registry.encoders)
    known = [set(kind) for kind in kinds]
    yield
    for kind, names in zip(kinds, known, strict=True):
        for name in set(kind) - names:
            del kind[name]
            kind.registered.discard(name)
