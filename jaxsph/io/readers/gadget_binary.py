r"""Gadget binary snapshots, format 1 and 2, of either byte order. One type of particles is read.

A snapshot is a sequence of Fortran records: the length of the data as uint32, the data, the length again. Format 2 puts
a record of 8 bytes with a name before each block; format 1 relies on the order POS VEL ID MASS U RHO (NE NH) HSML, and blocks
behind these are known by their lengths. The header has 256 bytes, or is GADGET-4's, of any number of types, with counts of 64
bits. A block is of those types, with one number or three a particle, that alone have its length: ages are of stars, metals of gas
and stars.
The support is HSML itself (Gadget convention). Units are left as stored; a box is taken to be periodic.
Sources: Springel, User guide for GADGET-2, section 6; the documentation of GADGET-4, "Snapshot file formats".
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxsph.io.damage import DataError, explained
from jaxsph.io.file_units import NO_COSMOLOGY
from jaxsph.io.parsing import Columns, choose_type, enter, others_held
from jaxsph.io.table import FileUnits, ParticleTable, box_of, single_number, usable_supports

SOURCE = "Gadget binary"
Order = Literal["<", ">"]
Layout = tuple[tuple[int, ...], int]  # of a block: the types that are in it, and numbers a particle
HEADER_BYTES = 256
NUM_TYPES = 6
OF_GADGET4 = {24 * types + 48: types for types in range(2, 11)}  # bytes of its header, and types of particles
HEADER = [
    ("count", "u4", NUM_TYPES), ("mass", "f8", NUM_TYPES), ("time", "f8"), ("redshift", "f8"), ("star_formation", "i4"),
    ("feedback", "i4"), ("total", "u4", NUM_TYPES), ("cooling", "i4"), ("files", "i4"), ("box", "f8"),
    ("matter", "f8"), ("lambda", "f8"), ("hubble", "f8"),
]  # fmt: skip
MAX_RECORDS = 512  # more than any code writes; a tail of zeros reads as empty records, one every eight bytes
GAS_BLOCKS = ("U", "RHO", "NE", "NH", "HSML", "SFR", "ENDT")
OF_TYPES = {"AGE": (4,), "Z": (0, 4)} | dict.fromkeys(GAS_BLOCKS, (0,))
COLUMN_NAMES = {
    "VEL": "velocity", "ID": "id", "MASS": "mass", "U": "internal_energy", "RHO": "density", "POT": "potential",
}  # fmt: skip


def read(path: Path, *, part_type: int | str | None = None) -> ParticleTable:
    """Read the particles of one type; without `part_type`, gas (0) or the first type there is."""
    with explained(path, SOURCE):
        content = np.fromfile(path, dtype=np.uint8)
        order = _byte_order(content[: max(OF_GADGET4) + 8].tobytes())
        if order is None:
            raise DataError(
                "does not begin with a record of 8 (format 2) or 256 bytes (format 1), nor GADGET-4's: it is no Gadget file"
            )
        blocks = _blocks(content, order)
        header = _header(blocks.pop("HEAD"), order)
        counts = header["count"].astype(np.int64)
        masses = {kind: one for kind, one in enumerate(header["mass"].tolist()) if one > 0}
        chosen = choose_type(np.flatnonzero(counts).tolist(), part_type, mass=masses)
        whole = header["total"] if header["files"] > 1 else counts
        said = [f"particles of type {chosen}", *others_held(dict(enumerate(whole.tolist())), chosen)]
        mass = float(header["mass"][chosen])
        if not 0 <= mass < np.inf:
            raise DataError(f"has mass {mass:g} for particles of type {chosen} in its header; correct that number there")
        columns: Columns = {}
        for name, raw in blocks.items():
            values = _block(name, raw, counts, header["mass"], chosen, order)
            if isinstance(values, str):
                said.append(values)
            elif values is not None:
                columns[COLUMN_NAMES.get(name, name)] = values
        if "POS" not in columns:
            raise DataError(f"has no block POS among {', '.join(blocks)}; write the snapshot again with positions")
        if "mass" not in columns and mass > 0:
            columns["mass"] = np.full(counts[chosen], mass)
            said.append(f"mass = {mass:g} for all (mass table in the header)")
        if "HSML" in columns:
            said.append("support = HSML (Gadget convention: the kernel ends there)")
        support, unusable = usable_supports(columns.get("HSML"))
        box_size, notes = box_of(np.ravel(header["box"])) if header["box"] else (None, [])
        said += notes
        said.append("kernel = cubic_spline (of Gadget-like codes unless told otherwise; the file does not say)")
        num_files = max(int(header["files"]), 1)
        more: dict[str, Any] = {"box_size": box_size, "time": single_number(header["time"]), "num_files": num_files}
        more |= {"conventions": tuple(said), "part_type": chosen, "kernel": "cubic_spline"}
        more |= {"announced": int(header["total"][chosen]), "unusable": unusable}
        is_today = header["matter"] > 0 and header["hubble"] not in (0, 1) and abs(header["time"] - 1) <= NO_COSMOLOGY
        if header["redshift"] > NO_COSMOLOGY or is_today:
            more["units"] = FileUnits(redshift=single_number(header["redshift"]), hubble=single_number(header["hubble"]) or None)
        return ParticleTable(columns.pop("POS"), columns, support, source=SOURCE, **more)


def looks_like(start: bytes) -> bool:
    """Whether a file that begins with `start` begins with a Gadget record."""
    return _byte_order(start) is not None


def _byte_order(start: bytes) -> Order | None:
    """That in which a file begins with a record of such a length as its first has, of format 2 or 1."""
    orders: tuple[Order, ...] = ("<", ">")
    for order in orders if len(start) >= 4 else ():
        length = int(np.frombuffer(start[:4], f"{order}u4")[0])
        if length in (8, HEADER_BYTES) or (length in OF_GADGET4 and start[4 + length : 8 + length] == start[:4]):
            return order
    return None


def _records(content: np.ndarray, order: Order) -> list[np.ndarray]:
    records: list[np.ndarray] = []
    at = 0
    while at < len(content):
        if len(records) == MAX_RECORDS:
            raise DataError(f"has more than {MAX_RECORDS} records (at byte {at}), so it is damaged or was not written to its end")
        length = int(content[at : at + 4].view(f"{order}u4")[0]) if at + 4 <= len(content) else 0
        stop = at + 4 + length
        if stop + 4 > len(content):
            raise DataError(f"is cut short: a block at byte {at} is not complete; copy it again")
        if content[stop : stop + 4].copy().view(f"{order}u4")[0] != length:
            raise DataError(f"is damaged: the block at byte {at} begins with length {length} and ends with another one")
        records.append(content[at + 4 : stop])
        at = stop + 4
    return records


def _blocks(content: np.ndarray, order: Order) -> Columns:
    """Blocks by name, `HEAD` first."""
    records = _records(content, order)
    if len(records[0]) == 8:
        names = [record[:4].tobytes().decode("ascii", errors="replace").strip() for record in records[0::2]]
        if any(len(record) != 8 for record in records[0::2]) or len(records) % 2:
            raise DataError("is damaged: its block names (format 2) are not where they must be; copy it again")
        blocks: Columns = {}
        for name, record in zip(names, records[1::2], strict=True):
            enter(blocks, name, record, "block")
    else:
        header = _header(records[0], order)
        names = ["HEAD", "POS", "VEL", "ID"]
        names += ["MASS"] if ((header["count"] > 0) & (header["mass"] == 0)).any() else []
        names += ["U", "RHO", *(["NE", "NH"] if header["cooling"] else []), "HSML"] if header["count"][0] > 0 else []
        blocks = dict(zip(names, records, strict=False))
        if len(blocks) < 4:
            raise DataError("is cut short: format 1 has at least POS, VEL and ID after its header; copy it again")
        for nth, record in enumerate(records[len(names) :], len(names)):  # what follows differs between codes
            fitting, names_of = _fitting(record, header["count"]), {(types, 1): name for name, types in OF_TYPES.items()}
            name = names_of.get(fitting[0], "") if len(fitting) == 1 and fitting[0][0] != (0,) else ""
            blocks[f"block {nth}" if not name or name in blocks else name] = record
    if len(blocks.get("HEAD", ())) not in (HEADER_BYTES, *OF_GADGET4):
        raise DataError("has no header of 256 bytes, nor GADGET-4's, as its first block, so it is damaged or another format")
    return blocks


def _header(record: np.ndarray, order: Order) -> dict[str, Any]:
    types = OF_GADGET4.get(len(record), 0)
    wide = [("count", "i8", types), ("total", "i8", types), ("mass", "f8", types)]
    more = [("time", "f8"), ("redshift", "f8"), ("box", "f8"), ("files", "i4")]
    dtype = np.dtype([*wide, *more] if types else HEADER).newbyteorder(order)
    header = record[: dtype.itemsize].view(dtype)[0]
    return {"cooling": 0, "matter": 0.0, "hubble": 0.0} | {name: header[name] for name in dtype.names or ()}


def _fitting(raw: np.ndarray, counts: np.ndarray) -> list[Layout]:
    """Sets of types whose particles fill a block of this length, with one or three numbers of four bytes each."""
    present = np.flatnonzero(counts).tolist()
    some = (types for size in range(1, len(present) + 1) for types in itertools.combinations(present, size))
    return [(types, width) for types in some for width in (1, 3) if 4 * _numbers_in((types, width), counts) == len(raw)]


def _numbers_in(layout: Layout, counts: np.ndarray) -> int:
    types, width = layout
    return width * int(counts[list(types)].sum())


def _known(name: str, counts: np.ndarray, masses: np.ndarray) -> Layout | None:
    """How a block of this name is laid out, where all codes agree."""
    everyone = tuple(range(len(counts)))
    if name in ("POS", "VEL", "ACCE"):
        return everyone, 3
    if name == "MASS":
        return tuple(np.flatnonzero((counts > 0) & (masses == 0)).tolist()), 1
    if name in ("ID", "POT", "TSTP"):
        return everyone, 1
    return (OF_TYPES[name], 1) if name in OF_TYPES else None


def _block(
    name: str, raw: np.ndarray, counts: np.ndarray, masses: np.ndarray, chosen: int, order: Order
) -> np.ndarray | str | None:
    """The rows of the chosen type, `None` where there are none, or a sentence where the block is not understood."""
    known = _known(name, counts, masses)
    size = next((size for size in (4, 8) if known and size * _numbers_in(known, counts) == len(raw)), 0)
    layouts = [known] if known and size else _fitting(raw, counts)
    if not size and known and name not in ("AGE", "Z"):
        raise DataError(f"has a block {name} of {len(raw)} bytes, which fits no number of its particles; copy it again")
    if len(layouts) > 1:
        meant = " or ".join(f"{width} of types {types}" for types, width in layouts)
        return f"left out {name}: its {len(raw)} bytes may be {meant.replace(',)', ')')} numbers"
    if not layouts:
        return f"left out {name}: its {len(raw)} bytes fit no number of particles"
    ((types, width),) = layouts
    if chosen not in types:
        return None
    values = raw.copy().view(f"{order}{'u' if name == 'ID' else 'f'}{size or 4}")
    start = int(counts[[each for each in types if each < chosen]].sum())
    rows = values.reshape(-1, width)[start : start + int(counts[chosen])]
    return rows if width > 1 else rows[:, 0]
