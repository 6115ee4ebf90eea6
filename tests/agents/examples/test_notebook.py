"""The notebook that introduces the project."""

import os

import pytest

from helpers.paths import ROOT

NOTEBOOK = ROOT / "agents" / "examples" / "quickstart.ipynb"
MAX_BYTES = 400_000
VARIES = "depends-on-machine"  # the tag of cells whose output a trained agent decides


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def printed(cell):
    return "".join(output.text for output in cell.outputs if output.get("name") == "stdout")


def test_stored_outputs_are_small_and_free_of_errors():
    nbformat = pytest.importorskip("nbformat")
    assert NOTEBOOK.stat().st_size < MAX_BYTES
    cells = code_cells(nbformat.read(NOTEBOOK, 4))
    assert any(cell.outputs for cell in cells)
    for cell in cells:
        assert cell.execution_count is not None
        assert all(output.output_type != "error" for output in cell.outputs)


def test_a_page_made_from_the_notebook_shows_every_animation():
    nbformat = pytest.importorskip("nbformat")
    outputs = [
        output.data
        for cell in code_cells(nbformat.read(NOTEBOOK, 4))
        for output in cell.outputs
        if "show_gif(" in cell.source and output.output_type == "execute_result"
    ]
    assert len(outputs) == 3
    assert all("data:image/gif;base64," in data["text/html"] for data in outputs)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of the libraries that run it
def test_a_run_prints_what_is_stored():
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    stored = nbformat.read(NOTEBOOK, 4)
    run = nbformat.read(NOTEBOOK, 4)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    nbclient.NotebookClient(run, timeout=600, kernel_name="python3").execute(env=environment)
    for before, after in zip(code_cells(stored), code_cells(run), strict=True):
        if VARIES not in before.metadata.get("tags", []):
            assert printed(after) == printed(before)
