"""The notebooks run from a fresh kernel, and are stored without results."""

import os
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "examples" / "notebooks").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_its_results(path, monkeypatch):
    if not os.environ.get("REQUIRE_EXTRAS"):
        pytest.importorskip("nbclient")
        pytest.importorskip("ipykernel")
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    outputs = [output for cell in cells for output in cell.outputs]
    written = "".join(output.text for output in outputs if output.get("name") == "stderr")
    assert not [line for line in written.splitlines() if "compiling kernels" not in line]
    shown = [output.data for output in outputs if "data" in output]
    assert any("<svg" in str(data.get("text/html")) for data in shown)
    assert any("application/vnd.plotly.v1+json" in data for data in shown)


def test_there_are_notebooks():
    assert len(NOTEBOOKS) == 3
