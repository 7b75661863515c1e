"""Which reader reads a file: what its first bytes say, else its suffix.

Flow: path -> [formats] -> reader -> ParticleTable.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.metadata
import sys
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from jaxsph.io.damage import DataError, regular_file
from jaxsph.io.readers import bgeo, changa, gadget_binary, hdf5, npz, phantom, ply, text, vtk, vtk_xml, xdmf
from jaxsph.io.snapshot_files import joined
from jaxsph.io.table import ParticleTable

SNIFFED_BYTES = 1024
READERS = "jaxsph.readers"  # the group of entry points by which packages bring formats of their own


@dataclasses.dataclass(frozen=True)
class Format:
    """A particle file format.

    Attributes:
        name: what users call it.
        suffixes: file name endings, in lower case.
        module: with its `read(path)`, or `read(path, part_type=...)` where `typed`, which gives a `ParticleTable`; of other
            packages its name, by which it is imported when a file is read.
        sniff: whether a file with these first bytes is of this format; `None` where content does not tell.
        typed: whether its `read` takes `part_type`.
        folder: whether a folder is a snapshot of this format; `None` where snapshots are files.
    """

    name: str
    suffixes: tuple[str, ...]
    module: ModuleType | str
    sniff: Callable[[bytes], bool] | None
    typed: bool = False
    folder: Callable[[Path], bool] | None = None


def _is_bgeo(start: bytes) -> bool:
    if start[:2] == b"\x1f\x8b":
        try:
            start = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16).decompress(start, 16)
        except zlib.error:
            return False
    return start[:4] == b"Bgeo"


FORMATS = (
    Format("NumPy archive", (".npz",), npz, lambda start: start[:4] in (b"PK\x03\x04", b"PK\x05\x06")),
    Format("HDF5: Gadget, SWIFT, GIZMO, AREPO, Phantom, PySPH or points", (".hdf5", ".h5", ".hdf"), hdf5,
           lambda start: start[:8] == b"\x89HDF\r\n\x1a\n", typed=True),
    Format("legacy VTK", (".vtk",), vtk, lambda start: start.startswith(b"# vtk DataFile")),
    Format("XDMF", (".xmf", ".xdmf"), xdmf, lambda start: b"<Xdmf" in start),
    Format("VTK XML", (".vtu", ".vtp", ".pvtu", ".pvtp", ".pvd"), vtk_xml, lambda start: b"<VTKFile" in start),
    Format("PLY", (".ply",), ply, lambda start: start[:4] in (b"ply\n", b"ply\r")),
    Format("Houdini bgeo", (".bgeo", ".bgeo.gz", ".bhclassic"), bgeo, _is_bgeo),
    Format("Phantom dump", (), phantom, phantom.looks_like, typed=True),
    Format("Tipsy", (".tipsy", ".std", ".tip"), changa, changa.looks_like, typed=True),
    Format("Gadget binary", (".gadget", ".gadget2", ".gad"), gadget_binary, gadget_binary.looks_like, typed=True),
    Format("NChilada", (".nchilada",), changa, None, typed=True, folder=changa.is_snapshot),
    Format("text table", (".csv", ".txt", ".xyz", ".dat", ".tsv", ".ascii", ".asc"), text, None),
)  # fmt: skip


@functools.cache
def installed_readers(path: tuple[str, ...]) -> tuple[importlib.metadata.EntryPoint, ...]:
    """What packages on `sys.path` bring; found once a process, as it takes longer than to read a small file."""
    return tuple(importlib.metadata.entry_points(group=READERS))


def added_formats() -> tuple[Format, ...]:
    """Formats that installed packages bring, as entry points `jaxsph.readers`; asked before those of this package.

    One that cannot be loaded is left out with a `UserWarning` that names it.
    """
    formats = []
    for point in installed_readers(tuple(sys.path)):
        try:
            form = point.load()
        except Exception as error:
            warnings.warn(f"reader {point.name!r} ({point.value}) cannot be loaded and is left out: {error}", stacklevel=2)
            continue
        if isinstance(form, Format):
            formats.append(form)
        else:
            warnings.warn(f"reader {point.name!r} ({point.value}) is no `jaxsph.io.Format` and is left out", stacklevel=2)
    return tuple(formats)


def find_format(path: Path) -> Format:
    """The format of the file at `path`."""
    path = regular_file(path, or_folder=True)
    formats = (*added_formats(), *FORMATS)
    if path.is_dir():
        form = next((form for form in formats if form.folder is not None and form.folder(path)), None)
        if form is None:
            raise DataError(f"{path}: is a folder, and no snapshot of a format that is one; give the name of a file in it")
        return form
    with path.open("rb") as file:
        start = file.read(SNIFFED_BYTES)
    by_content = next((form for form in formats if form.sniff is not None and form.sniff(start)), None)
    by_name = next((form for form in formats if path.name.lower().endswith(form.suffixes)), None)
    form = by_content or by_name
    if form is None:
        wrong = f"the format is known neither by content nor by the suffix {path.suffix!r}"
        known = "; ".join(f"{' '.join(form.suffixes) or 'no suffix'} ({form.name})" for form in formats)
        raise DataError(f"{path}: {wrong}; known are {known}")
    return form


def read_with(form: Format, path: Path, part_type: int | str | None) -> ParticleTable:
    """Read `path` as `form`; `ValueError` when a format without particle types is asked for one."""
    if not form.typed and part_type is not None:
        raise DataError(f"{path}: {form.name} files have no particle types; leave out `part_type` (got {part_type})")
    reader: Any = importlib.import_module(form.module) if isinstance(form.module, str) else form.module

    def read(file: Path, part_type: int | str | None) -> ParticleTable:
        file = regular_file(file, or_folder=True)
        table: ParticleTable = reader.read(file, part_type=part_type) if form.typed else reader.read(file)
        return table

    return dataclasses.replace(joined(path, part_type, read), path=str(path))
