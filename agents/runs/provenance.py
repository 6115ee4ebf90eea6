"""Hardware, versions and commit that a result was computed with."""

import importlib.metadata
import os
import pathlib
import platform
import re
import subprocess
from typing import Any

import jax

from agents.files import read_json, write_json

ROOT = pathlib.Path(__file__).parents[2]
VERSIONED = ("jax", "jaxlib", "flax", "optax", "numpy")
# Code that decides results; records and texts may change between two of them.
CODE = ("agents/*.py", "benchmarks/*.py", "trap_tube_jax/*.py", "pyproject.toml")


def provenance() -> dict[str, Any]:
    """Returns hardware, versions and commit as plain values."""
    return {
        "processor": _processor(),
        "cores": cores(),
        "device": jax.devices()[0].device_kind,
        "platform": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in VERSIONED},
        "commit": commit(),
    }


def note_provenance(path: pathlib.Path, devices: str) -> None:
    """Puts this machine, its versions and the commit at the end of a JSON file of such entries.

    Raises:
      ValueError: the file is damaged; it stays as it is.
    """
    here = {**provenance(), "devices": devices}
    others = [machine for machine in read_provenance(path) if machine != here]
    write_json(path, [*others, here])


def read_provenance(path: pathlib.Path) -> list[dict[str, Any]]:
    """Reads what `provenance` returned on the machines that trained a run, in order.

    Returns none if the file is missing.

    Raises:
      ValueError: the file is damaged; the message names it.
    """
    return read_json(path) if path.is_file() else []


def commit() -> str | None:
    """Returns the commit of the code, with "-dirty" where the code has changed since.

    Returns None without git, or if the project is not the root of its git checkout.
    """
    try:
        if pathlib.Path(_git("rev-parse", "--show-toplevel")).resolve() != ROOT.resolve():
            return None
        changes = _git("status", "--porcelain", "--", *CODE)
        return _git("rev-parse", "--short=12", "HEAD") + ("-dirty" if changes else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def cores() -> int:
    """Returns the number of cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _processor() -> str:
    info = pathlib.Path("/proc/cpuinfo")
    names = re.search(r"^model name\s*: (.+)$", info.read_text() if info.exists() else "", re.M)
    return names[1] if names else platform.processor()


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()
