"""NIfTI (`.nii`, `.nii.gz`), by nibabel: volumes with their affine map; later moments of a series by their number.

Source: the NIfTI-1 data format, nifti.nimh.nih.gov.
"""

from __future__ import annotations

import gzip
import math
import os
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from jaxsph.io.damage import DataError, explained
from jaxsph.io.libraries import require
from jaxsph.io.parsing import DEFLATE_RATIO, count_rest, refuse_leftover
from jaxsph.io.volumes.volume_files import VolumeTable, along_axes

SOURCE = "NIfTI"


def read(path: Path) -> VolumeTable:
    """Read a volume, or a series of volumes as components; integers without a scale stay integers.

    Raises:
        ValueError: damaged, cut short, longer than its header says, another number of axes, or oblique ones.
        ImportError: nibabel is not installed.
    """
    library = require("nibabel", f"reading {path}")
    with explained(path, SOURCE):
        image, values = _whole(library, path)
        while values.ndim > 3 and values.shape[-1] == 1:
            values = values[..., 0]
        if values.ndim not in (3, 4):
            raise DataError(f"has axes of {values.shape} points; write one volume of three axes")
        affine = np.asarray(image.affine, np.float64)
        return along_axes({"values": values}, affine[:3, 3], affine[:3, :3], SOURCE, ("coordinates are those of its affine map",))


def _whole(library: Any, path: Path) -> tuple[Any, np.ndarray]:
    """The image and its values, read into memory from the first byte of the file to the last.

    nibabel stops at the last voxel, before the check sum of gzip, and maps what is not compressed.
    """
    kind, is_packed = type(library.load(str(path))), path.name.lower().endswith(".gz")
    with gzip.open(path) if is_packed else path.open("rb") as stream:
        image = kind.from_file_map(kind.make_file_map({"image": stream}), mmap=False)
        data = image.dataobj
        need = data.offset + math.prod(data.shape) * data.dtype.itemsize
        room = os.path.getsize(path) * (DEFLATE_RATIO if is_packed else 1)
        if need > room:
            raise DataError(f"is cut short: its header announces {need} bytes, its {room} can be no more; copy it again")
        values = np.asanyarray(data)
        stream.seek(need)
        refuse_leftover(count_rest(cast(IO[bytes], stream), 0), f"{data.shape} of {data.dtype}")
    return image, values
