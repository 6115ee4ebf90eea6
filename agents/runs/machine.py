"""What a result was computed on: hardware, versions and commit."""

import importlib.metadata
import pathlib
import platform
import subprocess
from typing import Any

import jax

from agents.parallel.cores import available_cores

ROOT = pathlib.Path(__file__).parents[2]
VERSIONED = ("jax", "jaxlib", "flax", "optax", "numpy")
# What decides results; records and texts may change between two of them.
CODE = ("agents/*.py", "benchmarks/*.py", "trap_tube_jax/*.py", "pyproject.toml")
DIRTY = "-dirty"


def machine(commit: str | None = None) -> dict[str, Any]:
    """Hardware, versions and commit, for the record.

    Args:
      commit: the commit to note where git does not tell it.
    """
    return {
        "processor": _processor(),
        "cores": len(available_cores()),
        "device": jax.devices()[0].device_kind,
        "devices": jax.device_count(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in VERSIONED},
        "commit": _commit() or commit,
    }


def _processor() -> str:
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _commit() -> str | None:
    """The commit that the code is of, with "-dirty" where the code was changed since.

    None without git, or where the repository is another one that the package is installed in.
    """
    try:
        if pathlib.Path(_git("rev-parse", "--show-toplevel")).resolve() != ROOT.resolve():
            return None
        commit = _git("rev-parse", "--short=12", "HEAD")
        changes = _git("status", "--porcelain", "--", *CODE)
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + (DIRTY if changes else "")


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()
