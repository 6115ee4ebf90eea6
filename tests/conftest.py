"""Settings that hold for every test, made before any of them touches JAX."""

import atexit
import os
import shutil
import tempfile

import jax

FOLDER = "JAX_COMPILATION_CACHE_DIR"
if "PYTEST_XDIST_WORKER" not in os.environ:
    # Equal programs compile once for all workers, and for the processes that tests start. A
    # cache left by another version of the code must not decide what is tested.
    os.environ[FOLDER] = tempfile.mkdtemp(prefix="trap_tube_jax-tests-")
    atexit.register(shutil.rmtree, os.environ[FOLDER], ignore_errors=True)
    # Tests compile for longer than they compute.
    given = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"--xla_backend_optimization_level=0 {given}".strip()

SETTINGS = {
    "jax_compilation_cache_dir": os.environ[FOLDER],
    "jax_persistent_cache_min_compile_time_secs": 0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
    # An accidental broadcast between ranks is a bug that a shape test may not see.
    "jax_numpy_rank_promotion": "raise",
}
for name, value in SETTINGS.items():
    os.environ[name.upper()] = str(value)
    jax.config.update(name, value)
