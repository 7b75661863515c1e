"""Stores the pictures that notebooks make in them, and nothing else of a run: no times, no paths, no text.

python docs/store_notebooks.py [NAME ...]
"""

from __future__ import annotations

import base64
import io
import os
import pathlib
import sys
import tempfile
from typing import Any

import nbclient
import nbformat
import numpy as np
from PIL import Image

NOTEBOOKS = pathlib.Path(__file__).resolve().parent.parent / "notebooks"
PICTURE, PACKED = "image/png", "image/jpeg"
MAX_WIDTH, QUALITY, LARGE = 800, 85, 20_000
"""Pictures are stored no wider than this, as PNG, or where that has so many bytes as JPEG of this quality if it is smaller."""
MEASURED = "measured"
"""Tag of cells whose pictures show times: another run makes others."""


def executed(path: pathlib.Path, folder: pathlib.Path) -> Any:
    """The notebook after a run in a folder."""
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(folder)}}
    beside = str(NOTEBOOKS.parent / "benchmarks")  # whose scenes two of them show, as from their own folder
    found = os.pathsep.join(filter(None, (beside, os.environ.get("PYTHONPATH"))))
    client = nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources)
    client.execute(env=os.environ | {"PYTHONPATH": found})
    return notebook


def pictures(cell: Any) -> list[bytes]:
    """What a cell shows, as files."""
    shown = (output.get("data", {}) for output in cell.get("outputs", ()))
    return [base64.b64decode(data[kind]) for data in shown for kind in (PICTURE, PACKED) if kind in data]


def numbers(picture: bytes) -> np.ndarray:
    """A picture as (height, width, 3) of 0 to 255."""
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"), np.float64)


def packed(picture: bytes) -> tuple[str, bytes]:
    """The kind of file and the file of a picture that a notebook holds."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    image.thumbnail((MAX_WIDTH, image.height), Image.Resampling.LANCZOS)
    files = {kind: io.BytesIO() for kind in (PICTURE, PACKED)}
    image.save(files[PICTURE], "PNG", optimize=True)
    image.save(files[PACKED], "JPEG", optimize=True, quality=QUALITY)
    kind = min(files, key=lambda kind: len(files[kind].getvalue()))
    kind = kind if len(files[PICTURE].getvalue()) > LARGE else PICTURE
    return kind, files[kind].getvalue()


def output(picture: bytes) -> Any:
    """What a notebook holds of a picture."""
    kind, file = packed(picture)
    return nbformat.v4.new_output("display_data", data={kind: base64.b64encode(file).decode()})


def stored(path: pathlib.Path, run: Any) -> Any:
    """The notebook of a file with the pictures of a run."""
    notebook = nbformat.read(path, as_version=4)
    for cell, made in zip(notebook.cells, run.cells, strict=True):
        if cell.cell_type == "code":
            cell.execution_count = None
            cell.outputs = [output(picture) for picture in pictures(made)]
    return notebook


def main() -> None:
    """All notebooks, or those that are named."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        if not sys.argv[1:] or path.stem in sys.argv[1:]:
            with tempfile.TemporaryDirectory() as folder:
                nbformat.write(stored(path, executed(path, pathlib.Path(folder))), path)


if __name__ == "__main__":
    main()
