"""Every notebook runs from its first cell to its last (`make notebooks`), and none is stored with the output of a run."""

import ast
from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_there_are_notebooks():
    assert [path.stem[:3] for path in NOTEBOOKS] == ["000", "100", "200", "300", "400", "500", "600"]


@each_notebook
def test_a_notebook_is_stored_without_output_and_its_last_cells_assert(path):
    cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells), "clear the outputs before committing"
    code = "\n".join(line for cell in cells[-2:] for line in cell.source.splitlines() if not line.startswith(("%", "!")))
    assert any(isinstance(node, ast.Assert) for node in ast.walk(ast.parse(code)))


@pytest.mark.notebook
@each_notebook
def test_notebook_runs(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
