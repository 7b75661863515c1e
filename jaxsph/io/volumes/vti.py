"""VTK XML images (`.vti`): point data on a regular grid; cell data is not read.

Encodings are those of `vtk_xml`. Written files hold one array, appended and raw.
Source: VTK File Formats, Kitware, "XML File Formats", ImageData.
"""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jaxsph.io.damage import DataError, explained
from jaxsph.io.readers.vtk_xml import TYPES, Decoder, parsed
from jaxsph.io.volumes.volume_table import VolumeTable, along_axes

SOURCE = "VTK XML image"
Part = tuple[tuple[slice, ...], np.ndarray]  # where in the whole grid values belong, and the values, (nx, ny, nz, components)
MAX_INDEX = 2**31
NAMES = {kind: name for name, kind in TYPES.items()}


def read(path: Path) -> VolumeTable:
    """Read the point data of all pieces."""
    with explained(path, SOURCE):
        root, decoder = parsed(path, ("ImageData",), ".vti")
        image = root.find("ImageData")
        if image is None:
            raise DataError("has no ImageData, so it is cut short or damaged; copy it again")
        whole = _extent(image.get("WholeExtent"))
        shape = tuple((whole[:, 1] - whole[:, 0] + 1).tolist())
        parts: dict[str, list[Part]] = {}
        for piece in image.iter("Piece"):
            for name, part in _parts(piece, whole, decoder).items():
                parts.setdefault(name, []).append(part)
        if not parts:
            raise DataError("holds no values of points; turn values of cells into values of points, or copy the file again")
        arrays = {name: _joined(name, found, shape) for name, found in parts.items()}
        arrays = {name: values[..., 0] if values.shape[3] == 1 else values for name, values in arrays.items()}
        spacing = _numbers(image.get("Spacing", "1 1 1"), 3)
        steps = _numbers(image.get("Direction", "1 0 0 0 1 0 0 0 1"), 9).reshape(3, 3) * spacing
        said = tuple(f"left out {name}: not numbers" for name in dict.fromkeys(decoder.words))
        return along_axes(arrays, _numbers(image.get("Origin", "0 0 0"), 3) + steps @ whole[:, 0], steps, SOURCE, said)


def _parts(piece: ElementTree.Element, whole: np.ndarray, decoder: Decoder) -> dict[str, Part]:
    """A piece's values by name, with where they belong."""
    own = _extent(piece.get("Extent"))
    size = own[:, 1] - own[:, 0] + 1
    if (own[:, 0] < whole[:, 0]).any() or (own[:, 1] > whole[:, 1]).any():
        raise DataError(f"has a piece of extent {own.tolist()} outside of the whole, {whole.tolist()}; it is damaged")
    place = tuple(slice(low, low + points) for low, points in zip(own[:, 0] - whole[:, 0], size, strict=True))
    columns = decoder.point_data(piece, math.prod(size.tolist()))
    return {name: (place, values.reshape(*size[::-1], -1).transpose(2, 1, 0, 3)) for name, values in columns.items()}


def _joined(name: str, parts: list[Part], shape: tuple[int, ...]) -> np.ndarray:
    """The array of all pieces, which are of one type, agree where they meet, and leave no point out."""
    kinds = {f"{grid.dtype}, {grid.shape[3]} a point" for _, grid in parts}
    if len(kinds) > 1:
        raise DataError(f"has `{name}` as {' and as '.join(sorted(kinds))} in its pieces; write it again as one of them")
    if len(parts) == 1 and parts[0][1].shape[:3] == shape:
        return parts[0][1]
    left = math.prod(shape) - sum(math.prod(grid.shape[:3]) for _, grid in parts)
    if left <= 0:
        values, there = np.zeros((*shape, parts[0][1].shape[3]), parts[0][1].dtype), np.zeros(shape, bool)
        for place, grid in parts:
            if not np.array_equal(values[place][there[place]], grid[there[place]], equal_nan=grid.dtype.kind == "f"):
                raise DataError(f"has two values of `{name}` at one point, in two of its pieces; write it again")
            values[place], there[place] = grid, True
        left = int((~there).sum())
    if left:
        raise DataError(f"has `{name}` in its pieces, but not for {left} points of a grid of {math.prod(shape)}; copy it again")
    return values


def write(path: Path, values: np.ndarray, lower: np.ndarray, spacing: np.ndarray, name: str) -> None:
    """Write one array as appended raw data."""
    kind = NAMES[values.dtype.str[1:]]
    extent = " ".join(f"0 {points - 1}" for points in values.shape)
    numbers = {"Origin": lower, "Spacing": spacing}
    where = " ".join(f'{key}="{" ".join(repr(float(x)) for x in vector)}"' for key, vector in numbers.items())
    head = (
        '<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<ImageData WholeExtent="{extent}" {where}>\n<Piece Extent="{extent}"><PointData Scalars="{name}">\n'
        f'<DataArray type="{kind}" Name="{name}" format="appended" offset="0"/>\n'
        '</PointData></Piece></ImageData>\n<AppendedData encoding="raw">\n_'
    )
    data = np.ascontiguousarray(values.T, values.dtype.newbyteorder("<"))
    with path.open("wb") as file:
        file.write(head.encode("ascii") + np.uint64(data.nbytes).astype("<u8").tobytes())
        file.write(data.data)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")


def _extent(text: str | None) -> np.ndarray:
    """First and last index along x, y and z, (3, 2)."""
    extent = _numbers(text or "", 6).reshape(3, 2)
    if (extent[:, 1] < extent[:, 0]).any() or (extent % 1 != 0).any() or abs(extent).max() > MAX_INDEX:
        raise DataError(f"has the extent {text!r}, which is empty, or is not of whole numbers; write it again")
    return extent.astype(np.int64)


def _numbers(text: str, count: int) -> np.ndarray:
    found = np.array([float(word) for word in text.split()])
    if len(found) != count or not np.isfinite(found).all():
        raise DataError(f"has {text!r} where {count} numbers should be; it is damaged: copy it again")
    return found
