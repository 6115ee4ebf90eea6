"""The notebook that introduces the project."""

import os

import pytest

from helpers.paths import ROOT

NOTEBOOK = ROOT / "agents" / "examples" / "quickstart.ipynb"
VARIES = "depends-on-machine"  # the tag of cells whose output a trained agent decides


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def printed(cell):
    return "".join(output.text for output in cell.outputs if output.get("name") == "stdout")


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of the libraries that run it
def test_a_run_prints_what_is_stored():
    """And shows its three animations, which a page made from the notebook holds."""
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    stored = nbformat.read(NOTEBOOK, 4)
    run = nbformat.read(NOTEBOOK, 4)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    nbclient.NotebookClient(run, timeout=600, kernel_name="python3").execute(env=environment)
    for notebook in (stored, run):
        shown = [str(cell.outputs) for cell in code_cells(notebook) if "show_gif(" in cell.source]
        assert sum("data:image/gif;base64," in outputs for outputs in shown) == 3
    for before, after in zip(code_cells(stored), code_cells(run), strict=True):
        if VARIES not in before.metadata.get("tags", []):
            assert printed(after) == printed(before)
