"""What a result was computed on: hardware, versions and commit."""

import importlib.metadata
import os
import pathlib
import platform
import subprocess
from typing import Any

import jax

ROOT = pathlib.Path(__file__).parents[2]
VERSIONED = ("jax", "jaxlib", "flax", "optax", "numpy")
# What decides results; records and texts may change between two of them.
CODE = ("agents/*.py", "benchmarks/*.py", "trap_tube_jax/*.py", "pyproject.toml")
DIRTY = "-dirty"


def machine() -> dict[str, Any]:
    """Hardware, versions and commit, for the record."""
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in VERSIONED},
        "commit": _commit(),
    }


def _processor() -> str:
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _commit() -> str | None:
    """The commit that the code is of, with "-dirty" where the code was changed since."""
    try:
        commit = _git("rev-parse", "--short=12", "HEAD")
        changes = _git("status", "--porcelain", "--", *CODE)
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + (DIRTY if changes else "")


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()
