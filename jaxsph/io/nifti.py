"""NIfTI (`.nii`, `.nii.gz`), by nibabel: volumes with their affine map; later moments of a series by their number.

Source: the NIfTI-1 data format, nifti.nimh.nih.gov.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .damage import DataError, explained
from .optional import require
from .volume_table import VolumeTable, along_axes

SOURCE = "NIfTI"


def read(path: Path) -> VolumeTable:
    """Read a volume, or a series of volumes as components; integers without a scale stay integers.

    Raises:
        ValueError: damaged, cut short, another number of axes, or oblique ones.
        ImportError: nibabel is not installed.
    """
    library = require("nibabel", f"reading {path}")
    with explained(path, SOURCE):
        image = library.load(str(path))
        values = np.asanyarray(image.dataobj)
        while values.ndim > 3 and values.shape[-1] == 1:
            values = values[..., 0]
        if values.ndim not in (3, 4):
            raise DataError(f"has axes of {values.shape} points; write one volume of three axes")
        affine = np.asarray(image.affine, np.float64)
        return along_axes({"values": values}, affine[:3, 3], affine[:3, :3], SOURCE, ("coordinates are those of its affine map",))
