"""JAX's persistent compilation cache for the command lines."""

import os
import tempfile
from pathlib import Path

import jax


def enable_cache() -> None:
    """Keeps compiled programs from one process to the next, in `cache_folder()`.

    JAX's own settings take precedence: `JAX_COMPILATION_CACHE_DIR` names another folder,
    `JAX_ENABLE_COMPILATION_CACHE=0` compiles everything anew.
    """
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    # By default JAX keeps only what took over a second; a run compiles many smaller programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def cache_folder() -> Path:
    """Returns the cache's folder: in $XDG_CACHE_HOME, ~/.cache, or the temporary folder.

    The last one serves users without a home, as in some containers.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        parent = Path(base) if base else Path.home() / ".cache"
    except RuntimeError:  # neither HOME nor an entry in the user database
        parent = Path(tempfile.gettempdir()) / f"cache-{os.getuid()}"
    return parent / "trap_tube_jax" / "jax"
