"""Stores the pictures that notebooks make in them, and nothing else of a run: no times, no paths, no text.

python docs/store_notebooks.py [NAME ...]
"""

from __future__ import annotations

import base64
import io
import pathlib
import sys
import tempfile
from typing import Any

import nbclient
import nbformat
import numpy as np
from PIL import Image

NOTEBOOKS = pathlib.Path(__file__).resolve().parent.parent / "notebooks"
PICTURE = "image/png"
MEASURED = "measured"
"""Tag of cells whose pictures show times: another run makes others."""


def executed(path: pathlib.Path, folder: pathlib.Path) -> Any:
    """The notebook after a run in a folder."""
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(folder)}}
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    return notebook


def pictures(cell: Any) -> list[str]:
    """What a cell shows, as PNG in base64."""
    outputs = cell.get("outputs", ())
    return ["".join(output["data"][PICTURE].split()) for output in outputs if PICTURE in output.get("data", {})]


def numbers(picture: str) -> np.ndarray:
    """A picture in base64 as (height, width, 3) of 0 to 255."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB"), np.float64)


def stored(path: pathlib.Path, run: Any) -> Any:
    """The notebook of a file with the pictures of a run."""
    notebook = nbformat.read(path, as_version=4)
    for cell, made in zip(notebook.cells, run.cells, strict=True):
        if cell.cell_type == "code":
            cell.execution_count = None
            cell.outputs = [nbformat.v4.new_output("display_data", data={PICTURE: picture}) for picture in pictures(made)]
    return notebook


def main() -> None:
    """All notebooks, or those that are named."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        if not sys.argv[1:] or path.stem in sys.argv[1:]:
            with tempfile.TemporaryDirectory() as folder:
                nbformat.write(stored(path, executed(path, pathlib.Path(folder))), path)


if __name__ == "__main__":
    main()
