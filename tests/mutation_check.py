"""Plants single faults in the code, one at a time, and asks the tests to catch each.

    python tests/mutation_check.py            # every fault
    python tests/mutation_check.py tool wrap  # those whose line in the table has a word

Packages and tests are copied for it; the working tree is not touched. Exits with 1 if the
tests pass in spite of a fault, if a fault's text is not found exactly once, or if the tests
fail without any.
"""

import concurrent.futures
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

from faults import ENVIRONMENT_FAULTS, Fault
from faults_of_agents import AGENT_FAULTS

FAULTS = (*ENVIRONMENT_FAULTS, *AGENT_FAULTS)
ROOT = pathlib.Path(__file__).parent.parent
PACKAGES = ("trap_tube_jax", "agents")
# The child must import the copy, not an installed package.
CHILD = """
import pathlib, sys
import agents, trap_tube_jax
for package in (agents, trap_tube_jax):
    assert pathlib.Path(package.__file__).is_relative_to(pathlib.Path.cwd())
import pytest
sys.exit(pytest.main(["-x", "--no-header", "-p", "no:cacheprovider", "-n0", *sys.argv[1:]]))
"""


class Verdict(NamedTuple):
    """pytest's exit code, or 2 for whatever is neither a pass nor a failing test; and words."""

    code: int
    words: str


def main() -> int:
    words = sys.argv[1:]
    lines = {fault: f"{fault.module:12} {fault.description:42}" for fault in FAULTS}
    faults = [f for f in FAULTS if not words or any(word in lines[f] for word in words)]
    with tempfile.TemporaryDirectory() as directory:
        # All runs start from one snapshot, whatever is edited meanwhile.
        snapshot = _copy(ROOT, pathlib.Path(directory) / "snapshot")
        misplaced = [f for f in faults if _module(snapshot, f).read_text().count(f.old) != 1]
        for fault in misplaced:
            print(f"not exactly once in {fault.module}.py: {fault.old!r}")
        if misplaced:
            return 1
        with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
            control = sorted({fault.tests for fault in faults})
            unchanged = pool.map(lambda tests: _run(snapshot, tests), control)
            for tests, verdict in zip(control, unchanged, strict=True):
                if verdict.code != 0:
                    print(f"without a fault, {' '.join(tests)}: {verdict.words}")
                    return 1
            survivors = 0
            changed = pool.map(lambda fault: _run(snapshot, fault.tests, fault), faults)
            for fault, verdict in zip(faults, changed, strict=True):
                survivors += verdict.code != 1
                print(lines[fault], verdict.words, flush=True)
    print(f"{len(faults) - survivors} of {len(faults)} faults caught")
    return int(survivors > 0)


def _copy(source: pathlib.Path, target: pathlib.Path) -> pathlib.Path:
    without_caches = shutil.ignore_patterns("__pycache__")
    for name in (*PACKAGES, "tests"):
        shutil.copytree(source / name, target / name, ignore=without_caches)
    shutil.copy(source / "pyproject.toml", target)
    return target.resolve()


def _module(root: pathlib.Path, fault: Fault) -> pathlib.Path:
    package = "" if fault.module.startswith("agents/") else PACKAGES[0]
    return root / package / f"{fault.module}.py"


def _run(snapshot: pathlib.Path, tests: tuple[str, ...], fault: Fault | None = None) -> Verdict:
    """Runs the tests on a copy of the snapshot with the fault planted."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as directory:
        copy = _copy(snapshot, pathlib.Path(directory) / "copy")
        if fault:
            module = _module(copy, fault)
            module.write_text(module.read_text().replace(fault.old, fault.new))
        result = subprocess.run(
            [sys.executable, "-c", CHILD, *tests],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy)},
            capture_output=True,
            text=True,
            check=False,
        )
    seconds = f"({time.monotonic() - start:.0f} s)"
    failed = re.search(r"^(?:FAILED|ERROR) \S+?(\w+\.py::\S+)", result.stdout, re.MULTILINE)
    if result.returncode == 1 and failed:
        return Verdict(1, f"caught by {failed[1]} {seconds}")
    if result.returncode == 0:
        return Verdict(0, f"passes {seconds}")
    return Verdict(2, f"BROKEN RUN {seconds}: {(result.stdout + result.stderr)[-500:]}")


if __name__ == "__main__":
    sys.exit(main())
