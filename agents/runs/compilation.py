"""How programs are compiled: kept from one process to the next, or quickly."""

import os
from collections.abc import Callable
from concurrent import futures
from pathlib import Path
from typing import ParamSpec, TypeVar

import jax

from agents.config import Config

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Leaves out XLA's newer code generator for fused loops, and what LLVM takes longest for.
QUICKLY: dict[str, bool | str] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_llvm_disable_expensive_passes": True,
}


def default_folder() -> Path:
    """The cache's place: under $XDG_CACHE_HOME, or under ~/.cache where that is unset."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "trap_tube_jax" / "jax"


def enable_cache() -> None:
    """Keeps compiled programs from one process to the next, in `default_folder()`.

    JAX's own settings go before it: `JAX_COMPILATION_CACHE_DIR` for another folder,
    `JAX_ENABLE_COMPILATION_CACHE=0` to compile everything anew.
    """
    if jax.config.jax_compilation_cache_dir is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return
    jax.config.update("jax_compilation_cache_dir", str(default_folder()))
    # By default only what took over a second is kept; a run compiles many smaller programs.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def compiled(lowered: jax.stages.Lowered, config: Config) -> jax.stages.Compiled:
    """The program, compiled"""
    return lowered.compile()


def in_background(
    function: Callable[Arguments, Result], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> futures.Future[Result]:
    """The result to come of a function that runs in a thread of its own.

    XLA compiles without holding Python up.
    """
    worker = futures.ThreadPoolExecutor(1)
    result = worker.submit(function, *args, **kwargs)
    worker.shutdown(wait=False)
    return result
