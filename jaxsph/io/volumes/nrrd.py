"""NRRD (`.nrrd`, and `.nhdr` with its data beside it), by pynrrd: ASCII, raw, gzip and bzip2.

Source: the NRRD file format, teem.sourceforge.net/nrrd/format.html.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, explained, regular_file
from jaxsph.io.libraries import require
from jaxsph.io.parsing import refuse_leftover
from jaxsph.io.volumes.volume_table import VolumeTable, along_axes

SOURCE = "NRRD"


def read(path: Path) -> VolumeTable:
    """Read a grid of three axes, or of four of which one is no space: components, named by their number.

    Raises:
        ValueError: damaged, cut short, longer than its header says, another number of axes, or oblique ones.
        ImportError: pynrrd is not installed.
    """
    library = require("nrrd", f"reading {path}")
    with explained(path, SOURCE):
        values, header = _whole(library, path)
        directions = header.get("space directions")
        spatial = _spatial_axes(header, values.ndim)
        if len(spatial) != 3 or values.ndim > 4:
            raise DataError(f"has {values.ndim} axes of which {len(spatial)} are space; write the three of one volume")
        values = np.moveaxis(values, spatial, (0, 1, 2))
        if directions is not None:
            rows = [np.asarray(directions[axis], np.float64) for axis in spatial]
            if any(row.shape != (3,) for row in rows):
                raise DataError(f"has directions of {rows[0].size} numbers; write it in a space of three dimensions")
            steps = np.stack(rows, 1)
        else:
            spacing = np.asarray(header.get("spacings", np.ones(values.ndim)), np.float64)[spatial]
            steps = np.diag(np.where(np.isnan(spacing), 1.0, spacing))
        origin = np.nan_to_num(np.asarray(header.get("space origin", np.zeros(3)), np.float64))
        said = (f"coordinates are those of its space, {header['space']}",) if "space" in header else ()
        return along_axes({"values": values}, origin, steps, SOURCE, said)


def _whole(library: Any, path: Path) -> tuple[np.ndarray, Any]:
    """Values and header; nothing may be left over behind the values, where pynrrd does not look."""
    with path.open("rb") as file:
        header = library.read_header(file)
        beside = header.get("data file", header.get("datafile"))
        stored = path if beside is None else regular_file(path.parent / beside)
        start = file.tell() if beside is None else 0
        values = library.read_data(header, file, str(path), index_order="F")
    lines, skipped = (int(header.get(f"{what} skip", header.get(f"{what}skip", 0))) for what in ("line", "byte"))
    size = skipped + values.nbytes
    with stored.open("rb") as file:
        if skipped >= 0 and header["encoding"] == "raw":  # pynrrd refuses no more than whole numbers of bytes
            file.seek(start)
            for _ in range(lines):
                file.readline()
            refuse_leftover(os.path.getsize(stored) - file.tell() - size, f"{size} bytes of values")
        elif skipped >= 0 and header["encoding"] in ("gzip", "gz"):  # what follows it, or its end lacks, is not looked at
            file.seek(-4, os.SEEK_END)
            if int.from_bytes(file.read(), "little") != size % 2**32:
                lacks = "it is cut short, or something follows"
                raise DataError(f"does not end with its length of {size} bytes, as gzip does: {lacks}")
    return values, header


def _spatial_axes(header: Any, axes: int) -> list[int]:
    """Axes that lie in space: those with a direction, or of a kind that is space; of three, all."""
    directions = header.get("space directions")
    if directions is not None:
        known = [row is not None and bool(np.isfinite(np.asarray(row, np.float64)).all()) for row in directions]
        return [axis for axis in range(axes) if known[axis]]
    kinds = header.get("kinds", ["space"] * axes)
    return list(range(axes)) if axes == 3 else [axis for axis in range(axes) if kinds[axis] in ("space", "domain")]
