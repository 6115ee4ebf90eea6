"""The notebook that introduces the project."""

import os
import subprocess
import sys

import pytest

from paths import ROOT

NOTEBOOK = ROOT / "agents" / "examples" / "quickstart.ipynb"
MAX_BYTES = 400_000


def test_stored_outputs_are_small_and_free_of_errors():
    nbformat = pytest.importorskip("nbformat")
    assert NOTEBOOK.stat().st_size < MAX_BYTES
    cells = [cell for cell in nbformat.read(NOTEBOOK, 4).cells if cell.cell_type == "code"]
    assert any(cell.outputs for cell in cells)
    for cell in cells:
        assert cell.execution_count is not None
        assert all(output.output_type != "error" for output in cell.outputs)


@pytest.mark.slow
def test_runs():
    pytest.importorskip("nbmake")
    options = ["--nbmake", "--nbmake-timeout=600", "-n", "0", "-m", "", "-W", "default"]
    command = [sys.executable, "-m", "pytest", *options, str(NOTEBOOK)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, check=False, cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-5000:]
    assert "1 passed" in done.stdout
