"""Volumes of scanners: NRRD (`.nrrd`, and `.nhdr` with its data beside it) by pynrrd, and NIfTI (`.nii`, `.nii.gz`) by nibabel.

NRRD is read as ASCII, raw, gzip and bzip2. Of NIfTI, volumes have their affine map, and later moments of a series their number.
Source: the NRRD file format, teem.sourceforge.net/nrrd/format.html; the NIfTI-1 data format, nifti.nimh.nih.gov.
"""

from __future__ import annotations

import bz2
import functools
import gzip
import io as memory_io
import math
import os
import zlib
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from jaxsph.io.damage import DataError, explained, inside, regular_file, require
from jaxsph.io.parsing import DEFLATE_RATIO, Decompressor, count_rest, numbers, refuse_leftover, refuse_missing, unpack_blocks
from jaxsph.io.volumes.volume_table import VolumeTable, along_axes

NRRD, NIFTI = "NRRD", "NIfTI"
TEXTS = "ASCII", "ascii", "text", "txt"
_GZIP = functools.partial(zlib.decompressobj, zlib.MAX_WBITS | 16)
UNPACKING: dict[str, Decompressor] = {"gzip": _GZIP, "gz": _GZIP, "bzip2": bz2.BZ2Decompressor, "bz2": bz2.BZ2Decompressor}


def nrrd(path: Path) -> VolumeTable:
    """Read a grid of three axes, or of four of which one is no space: components, named by their number."""
    library = require("nrrd", f"reading {path}")
    with explained(path, NRRD):
        values, header = _whole_nrrd(library, path)
        directions = header.get("space directions")
        said: list[str] = []
        spatial = _spatial_axes(header, values.ndim)
        if len(spatial) != 3 or values.ndim > 4:
            raise DataError(f"has {values.ndim} axes of which {len(spatial)} are space; write the three of one volume")
        values = np.moveaxis(values, spatial, (0, 1, 2))
        if directions is not None:
            rows = [np.asarray(directions[axis], np.float64) for axis in spatial]
            if any(row.shape != (3,) for row in rows):
                raise DataError(f"has directions of {rows[0].size} numbers; write it in a space of three dimensions")
            steps = np.stack(rows, 1)
            first = np.zeros(3)
        else:
            first, steps, said = _place(header, spatial, np.array(values.shape[:3]))
        origin = np.nan_to_num(np.asarray(header.get("space origin", first), np.float64))
        said += [f"coordinates are those of its space, {header['space']}"] if "space" in header else []
        return along_axes({"values": values}, origin, steps, NRRD, tuple(said))


def _whole_nrrd(library: Any, path: Path) -> tuple[np.ndarray, Any]:
    """Values and header. pynrrd reads no data: it looks neither behind the values nor where the file of them lies."""
    with path.open("rb") as file:
        header = library.read_header(file)
        start = file.tell()
    beside = header.get("data file", header.get("datafile"))
    if beside is not None:
        path, start = inside(regular_file(Path(os.path.abspath(path)).parent / beside), path, f"has its data in `{beside}`"), 0
    sizes, encoding = header["sizes"].tolist(), header["encoding"]
    lines, skipped = (int(header.get(f"{what} skip", header.get(f"{what}skip", 0))) for what in ("line", "byte"))
    if min(sizes) < 1 or len(sizes) != header["dimension"] or lines < 0 or skipped < (-1 if encoding == "raw" else 0):
        raise DataError(f"has sizes {sizes}, and skips {lines} lines and {skipped} bytes; it is damaged: write it again")
    nothing = {"type": header["type"], "endian": header.get("endian", "little"), "encoding": "raw", "dimension": 1}
    dtype = library.read_data({**nothing, "sizes": np.zeros(1, int)}, memory_io.BytesIO()).dtype
    count = math.prod(sizes)
    with path.open("rb") as file:
        file.seek(start)
        for _ in range(lines):
            file.readline()
        if skipped < 0:
            file.seek(-count * dtype.itemsize, os.SEEK_END)
        content, behind = file.read(), max(skipped, 0)
    need = behind + count * dtype.itemsize
    if encoding in UNPACKING:
        content = unpack_blocks([content], UNPACKING[encoding], need, "its values")
    if encoding in TEXTS:
        values = numbers(content[behind:].split(), dtype)
        refuse_leftover(len(values) - count, f"{count} values", "numbers")
    else:
        refuse_leftover(len(content) - need, f"{need} bytes of values")
        values = np.frombuffer(content, dtype, min(count, (len(content) - behind) // dtype.itemsize), behind)
    refuse_missing(count, len(values), "values")
    return values.reshape(sizes, order="F"), header


def _place(header: Any, spatial: list[int], sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """The first point and steps where there are no directions, and a note: of cells unless said of nodes, as teem takes them."""

    def of(name: str) -> np.ndarray:
        given = header.get(name, header.get(name.replace(" ", "")))
        return np.full(3, np.nan) if given is None else np.asarray(given, np.float64)[spatial]

    lower, upper, spacing = of("axis mins"), of("axis maxs"), of("spacings")
    centered = header.get("centerings") or header.get("centers", "").split() or [""] * len(header["sizes"])
    half = np.array([0.0 if centered[axis] == "node" else 0.5 for axis in spatial])
    steps = np.where(np.isnan(spacing), (upper - lower) / np.maximum(sizes - 1 + 2 * half, 1), spacing)
    steps = np.where(np.isnan(steps), 1.0, steps)
    note = f"placed by `axis mins` and `axis maxs`, of {'cells' if half.any() else 'nodes'}"
    return np.where(np.isnan(lower), 0.0, lower + half * steps), np.diag(steps), [] if np.isnan([lower, upper]).all() else [note]


def _spatial_axes(header: Any, axes: int) -> list[int]:
    """Axes that lie in space: those with a direction, or of a kind that is space; of three, all."""
    directions = header.get("space directions")
    if directions is not None:
        known = [row is not None and bool(np.isfinite(np.asarray(row, np.float64)).all()) for row in directions]
        return [axis for axis in range(axes) if known[axis]]
    kinds = header.get("kinds", ["space"] * axes)
    return list(range(axes)) if axes == 3 else [axis for axis in range(axes) if kinds[axis] in ("space", "domain")]


def nifti(path: Path) -> VolumeTable:
    """Read a volume, or a series of volumes as components; integers without a scale stay integers."""
    library = require("nibabel", f"reading {path}")
    with explained(path, NIFTI):
        image, values = _whole_nifti(library, path)
        while values.ndim > 3 and values.shape[-1] == 1:
            values = values[..., 0]
        if values.ndim not in (3, 4):
            raise DataError(f"has axes of {values.shape} points; write one volume of three axes")
        affine = np.asarray(image.affine, np.float64)
        return along_axes({"values": values}, affine[:3, 3], affine[:3, :3], NIFTI, ("coordinates are those of its affine map",))


def _whole_nifti(library: Any, path: Path) -> tuple[Any, np.ndarray]:
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
