"""The persistent compilation cache of the command lines."""

import os
from pathlib import Path

import jax


def default_folder() -> Path:
    """The cache's place: under $XDG_CACHE_HOME, or under ~/.cache where that is unset."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "trap_tube_jax" / "jax"


def enable(folder: Path | None = None) -> None:
    """Keeps compiled programs from one process to the next.

    Args:
      folder: where; `default_folder()` if absent. Made if missing.
    """
    folder = default_folder() if folder is None else folder
    jax.config.update("jax_enable_compilation_cache", True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # By default only what took over a second is kept; a run compiles many smaller programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
