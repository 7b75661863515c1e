"""XDMF (`.xmf`, `.xdmf`): points and their attributes, as text in the file itself or in HDF5 files beside it.

Of grids one after the other in time the last is read; those beside each other in space are joined. Topology is not read.
Source: XDMF Model and Format, version 3, www.xdmf.org.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jaxsph.io.damage import DataError, explained, inside
from jaxsph.io.parsing import enter, gather_vectors, numbers
from jaxsph.io.readers.hdf5_guards import followed, opened, read_dataset
from jaxsph.io.readers.vtk_xml import xml_of
from jaxsph.io.snapshot_files import concatenated
from jaxsph.io.table import ParticleTable, refuse_shape, single_number, table_from_columns

SOURCE = "XDMF"
KINDS = {"Float": "f", "Int": "i", "UInt": "u", "Char": "i", "UChar": "u"}
GEOMETRIES = {"XYZ": 3, "XY": 2, "X_Y_Z": 1, "X_Y": 1}
CONVERT = "write it with plain data items, or open it in ParaView and save the points as .vtp"


def read(path: Path) -> ParticleTable:
    """Read points and what they have; attributes that cannot be read are left out, and said so."""
    with explained(path, SOURCE):
        root = xml_of(path.read_bytes())
        if root.tag != "Xdmf":
            raise DataError(f"is XML of {root.tag}, not of Xdmf; {CONVERT}")
        grids, time, said = _grids(root.findall("Domain/Grid"))
        if not grids:
            raise DataError(f"has no Grid with a Geometry, so there are no points; {CONVERT}")
        table = concatenated([_table(grid, path) for grid in grids], 1)
        return dataclasses.replace(table, time=time, conventions=(*said, *table.conventions))


def _grids(grids: list[ElementTree.Element]) -> tuple[list[ElementTree.Element], float | None, list[str]]:
    """The uniform grids that are read, their time, and a note on others."""
    read: list[ElementTree.Element] = []
    time, said = None, []
    for grid in grids:
        inner = grid.findall("Grid")
        if grid.get("CollectionType", "").lower() == "temporal" and len(inner) > 1:
            said.append(f"the last of {len(inner)} moments")
            inner = inner[-1:]
        stated = grid.find("Time")
        time = time if stated is None or stated.get("Value") is None else single_number(float(stated.get("Value", "")))
        below, own, more = _grids(inner) if inner else ([grid] if grid.find("Geometry") is not None else [], None, [])
        read, time, said = [*read, *below], time if own is None else own, [*said, *more]
    return read, time, said


def _table(grid: ElementTree.Element, path: Path) -> ParticleTable:
    geometry = grid.find("Geometry")
    assert geometry is not None
    kind = geometry.get("GeometryType", geometry.get("Type", "XYZ")).upper()
    if kind not in GEOMETRIES:
        raise DataError(f"has a Geometry of type {kind}, and points are of {', '.join(GEOMETRIES)}; {CONVERT}")
    items = [_numbers(item, path) for item in geometry.findall("DataItem")]
    axes = items if GEOMETRIES[kind] == 1 else list(np.concatenate(items).reshape(-1, GEOMETRIES[kind]).T)
    if len({len(axis) for axis in axes}) != 1 or len(axes) not in (2, 3):
        raise DataError(f"has a Geometry of {len(items)} arrays that give no points; write it again")
    position, _ = gather_vectors(dict(zip("xyz", map(np.ravel, axes), strict=False)))
    columns: dict[str, np.ndarray] = {}
    said = []
    for attribute in grid.findall("Attribute"):
        name, item = attribute.get("Name", "unnamed"), attribute.find("DataItem")
        try:
            values = np.zeros(0) if item is None else _numbers(item, path)
            refuse_shape(values.shape, len(position))
            enter(columns, name, values.reshape(len(position), math.prod(values.shape[1:])), "attribute")
        except (ValueError, TypeError, OverflowError) as error:  # of words, and of numbers of no such kind
            said.append(f"left out {name}: {error}")
    return table_from_columns(position, columns, source=SOURCE, conventions=said)


def _numbers(item: ElementTree.Element, path: Path) -> np.ndarray:
    """The numbers of one data item, in its shape."""
    text, form = (item.text or "").strip(), item.get("Format", "XML").upper()
    if item.get("ItemType", "Uniform") != "Uniform" or item.get("Reference") or form not in ("XML", "HDF"):
        raise DataError(f"has data of type {item.get('ItemType', form)}, which is not read; {CONVERT}")
    if form == "XML":
        dtype = np.dtype(f"{KINDS.get(item.get('NumberType', 'Float'), 'f')}{item.get('Precision', '4')}")
        values = numbers(text.split(), dtype)
    else:
        file, _, name = text.rpartition(":")
        place = inside(file, path, f"has data in `{file}`")
        with opened(place) as content:
            dataset = followed(content, name) if name.strip("/") else None
            if dataset is None or not hasattr(dataset, "dtype") or dataset.dtype.kind not in "fiub":
                raise DataError(f"has no numbers called `{name}`, which {path.name} asks for")
            values = read_dataset(dataset)
    shape = tuple(map(int, item.get("Dimensions", str(len(values))).split()))
    if math.prod(shape) != values.size or min(shape, default=1) < 0:
        raise DataError(f"has data of {values.size} numbers where {shape} are announced; it is cut short: copy it again")
    return values.reshape(shape)
