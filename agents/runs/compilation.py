"""JAX's persistent compilation cache for the command lines."""

import os
from pathlib import Path

import jax


def enable_cache() -> None:
    """Keeps compiled programs from one process to the next, in $XDG_CACHE_HOME or ~/.cache.

    JAX's own settings take precedence: `JAX_COMPILATION_CACHE_DIR` names another folder,
    `JAX_ENABLE_COMPILATION_CACHE=0` disables the cache. A folder that other users can write to,
    such as /tmp, would let them choose the code that runs.
    """
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    try:
        parent = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # neither HOME nor an entry in the user database, as in some containers
        return
    jax.config.update("jax_compilation_cache_dir", str(parent / "trap_tube_jax" / "jax"))
    # By default JAX keeps only what took over a second; a run compiles many smaller programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
