"""Every notebook runs from its first cell to its last (`make notebooks`), and makes the pictures that are stored in it."""

import ast
from pathlib import Path

import nbformat
import numpy as np
import pytest
from tools import tool

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MAX_BYTES = 300_000
DIFFERENCE = 2  # of 255, in the mean of a picture
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@pytest.fixture(scope="module")
def storing():
    return tool("docs", "store_notebooks")


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_there_are_notebooks():
    numbers = ["000", "010", "020", "030", "040", "050", "060", "070", "100", "200", "210", "300", "400", "500", "600"]
    assert [path.stem[:3] for path in NOTEBOOKS] == numbers


@each_notebook
def test_a_notebook_is_stored_with_pictures_alone_and_its_last_cells_assert(path, storing):
    cells = code_cells(nbformat.read(path, as_version=4))
    assert not any(cell.execution_count for cell in cells)
    kinds = {storing.PICTURE}, {storing.PACKED}
    assert all(set(output.data) in kinds for cell in cells for output in cell.outputs), "python docs/store_notebooks.py"
    assert any(cell.outputs for cell in cells) and path.stat().st_size < MAX_BYTES
    code = "\n".join(line for cell in cells[-2:] for line in cell.source.splitlines() if not line.startswith(("%", "!")))
    assert any(isinstance(node, ast.Assert) for node in ast.walk(ast.parse(code)))


@pytest.mark.notebook
@each_notebook
def test_a_notebook_runs_and_makes_the_pictures_that_are_stored_in_it(path, storing, tmp_path):
    cells, fresh = code_cells(nbformat.read(path, as_version=4)), code_cells(storing.executed(path, tmp_path))
    for cell, made in zip(cells, fresh, strict=True):
        kept, new = storing.pictures(cell), [storing.packed(picture)[1] for picture in storing.pictures(made)]
        assert len(kept) == len(new), f"python docs/store_notebooks.py {path.stem}"
        if storing.MEASURED in cell.metadata.get("tags", ()):
            continue
        for one, other in zip(map(storing.numbers, kept), map(storing.numbers, new), strict=True):
            assert one.shape == other.shape and np.abs(one - other).mean() < DIFFERENCE
