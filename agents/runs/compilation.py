"""JAX's persistent compilation cache for the command lines."""

import os
from pathlib import Path

import jax


def enable_cache() -> None:
    """Keeps compiled programs from one process to the next, in `cache_folder()` if there is one.

    JAX's own settings take precedence: `JAX_COMPILATION_CACHE_DIR` names another folder,
    `JAX_ENABLE_COMPILATION_CACHE=0` compiles everything anew.
    """
    folder = cache_folder()
    if jax.config.values["jax_compilation_cache_dir"] is not None or folder is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # By default JAX keeps only what took over a second; a run compiles many smaller programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def cache_folder() -> Path | None:
    """Makes and returns the cache's folder, in $XDG_CACHE_HOME or ~/.cache.

    Returns None where there is no home or none that can be written, as in some containers. A
    folder that other users can write, such as /tmp, would let them choose what runs.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        parent = Path(base) if base else Path.home() / ".cache"
        folder = parent / "trap_tube_jax" / "jax"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: neither HOME nor an entry in the user database
        return None
    return folder if os.access(folder, os.W_OK) else None
