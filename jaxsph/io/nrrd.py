"""NRRD (`.nrrd`, and `.nhdr` with its data beside it), by pynrrd: ASCII, raw, gzip and bzip2.

Source: the NRRD file format, teem.sourceforge.net/nrrd/format.html.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .damage import DataError, explained
from .optional import require
from .volume_table import VolumeTable, along_axes

SOURCE = "NRRD"


def read(path: Path) -> VolumeTable:
    """Read a grid of three axes, or of four of which one is no space: components, named by their number.

    Raises:
        ValueError: damaged, cut short, another number of axes, or oblique ones.
        ImportError: pynrrd is not installed.
    """
    library = require("nrrd", f"reading {path}")
    with explained(path, SOURCE):
        values, header = library.read(str(path), index_order="F")
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


def _spatial_axes(header: Any, axes: int) -> list[int]:
    """Axes that lie in space: those with a direction, or of a kind that is space; of three, all."""
    directions = header.get("space directions")
    if directions is not None:
        known = [row is not None and bool(np.isfinite(np.asarray(row, np.float64)).all()) for row in directions]
        return [axis for axis in range(axes) if known[axis]]
    kinds = header.get("kinds", ["space"] * axes)
    return list(range(axes)) if axes == 3 else [axis for axis in range(axes) if kinds[axis] in ("space", "domain")]
