"""Tipsy files, of Gasoline, PKDGRAV and ChaNGa: one kind of particles is read.

A header (time, numbers of bodies, dimensions, gas, dark matter, stars), then records of gas, dark matter and stars, all of four
bytes a number; big-endian as the standard has it, or in the order of the machine that wrote it. Types are numbered as in Gadget
files: 0 gas, 1 dark matter, 4 stars. The length `hsmooth` of gas records is a softening in some codes and a smoothing length in
others; arrays beside the file, `FILE.smoothlength` and `FILE.den`, may hold smoothing lengths and densities. Lengths are half of
the support where a sample of neighbours shows that (`stored`), else supports are found from neighbours. Units are those of a file
of parameters beside it (`param_files`). Source: the documentation of TIPSY, University of Washington N-Body Shop.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .damage import DataError, NoParticlesError, explained
from .leftover import refuse_leftover
from .param_files import units_beside
from .stored import with_stored_lengths
from .table import ParticleTable
from .tipsy_arrays import arrays_beside

SOURCE = "Tipsy"
Order = Literal["<", ">"]
ORDERS: tuple[Order, Order] = (">", "<")
HEADER = np.dtype([("time", "f8"), ("bodies", "i4"), ("dimensions", "i4"), ("gas", "i4"), ("dark", "i4"), ("stars", "i4")])
SMOOTHING = "smoothlength", "hsmooth"
PLACE = ("mass", "x", "y", "z", "vx", "vy", "vz")
RECORDS = {
    0: ("gas", (*PLACE, "rho", "temp", "hsmooth", "metals", "phi")),
    1: ("dark", (*PLACE, "eps", "phi")),
    4: ("stars", (*PLACE, "metals", "tform", "eps", "phi")),
}
"""Number of a type -> its count in the header, and the numbers of a record."""


def looks_like(start: bytes) -> bool:
    """Whether a file that begins with `start` begins with a Tipsy header: three dimensions, and numbers that add up."""
    return any(_is_header(header) for _, header in _headers(start))


def read(path: Path, *, part_type: int | None = None) -> ParticleTable:
    """Read the particles of one type: gas if there is any, else the first that there is.

    Raises:
        ValueError: damaged; no particles of that type.
    """
    with explained(path, SOURCE):
        with path.open("rb") as file:
            order, header = _header(file.read(HEADER.itemsize))
            counts = {number: int(header[name]) for number, (name, _) in RECORDS.items()}
            sizes = {number: 4 * len(fields) for number, (_, fields) in RECORDS.items()}
            records = sum(counts[number] * sizes[number] for number in RECORDS)
            begin = os.path.getsize(path) - records
            if begin not in (HEADER.itemsize, HEADER.itemsize + 4):
                stated = ", ".join(f"{counts[number]} {name}" for number, (name, _) in RECORDS.items())
                raise DataError(f"is damaged or cut short: its header states {stated}, but its size is another; copy it again")
            _refuse_padding(order, file.read(begin - HEADER.itemsize))
            present = [number for number in RECORDS if counts[number]]
            chosen = part_type if part_type is not None else (present or [0])[0]
            if part_type is not None and chosen not in present:
                raise NoParticlesError(f"has no particles of type {part_type}; `part_type` can be {', '.join(map(str, present))}")
            file.seek(begin + sum(counts[number] * sizes[number] for number in RECORDS if number < chosen))
            fields = RECORDS[chosen][1]
            values = np.frombuffer(file.read(counts[chosen] * sizes[chosen]), f"{order}f4").reshape(-1, len(fields))
        rows = slice(first := sum(counts[number] for number in RECORDS if number < chosen), first + counts[chosen])
        beside, said = arrays_beside(path, sum(counts.values()), counts[0], rows)
        return _table(path, values.astype(np.float32), chosen, beside, said, float(header["time"]))


def _refuse_padding(order: Order, padding: bytes) -> None:
    """Refuse what is no padding of the standard, which is zero; machines leave what they have between header and records."""
    if order == ">":
        refuse_leftover(len(padding.strip(b"\0")), "its header and its records")


def _table(
    path: Path, values: np.ndarray, chosen: int, beside: dict[str, np.ndarray], said: list[str], time: float
) -> ParticleTable:
    kind, fields = RECORDS[chosen]
    columns = {name: values[:, nth] for nth, name in enumerate(fields) if name not in PLACE[1:]}
    columns |= {"velocity": values[:, 4:7], **beside}
    units, told = units_beside(path, columns, time)
    said = [f"particles of type {chosen} ({kind})", *said, *told]
    said.append("kernel = cubic_spline (ChaNGa's and Gasoline's unless compiled otherwise; the file does not say)")
    more: dict[str, Any] = {"conventions": tuple(said), "units": units, "time": time, "part_type": chosen}
    more["kernel"] = "cubic_spline"
    return with_stored_lengths(ParticleTable(values[:, 1:4], columns, source=SOURCE, **more), *SMOOTHING)


def _header(start: bytes) -> tuple[Order, np.void]:
    for order, header in _headers(start):
        if _is_header(header):
            return order, header
    raise DataError("does not begin with a Tipsy header of three dimensions; it is another format, or damaged")


def _headers(start: bytes) -> list[tuple[Order, np.void]]:
    """The header, as it is in either byte order."""
    if len(start) < HEADER.itemsize:
        return []
    return [(order, np.frombuffer(start[: HEADER.itemsize], HEADER.newbyteorder(order))[0]) for order in ORDERS]


def _is_header(header: np.void) -> bool:
    counts = [int(header[name]) for name in ("gas", "dark", "stars")]
    return int(header["dimensions"]) == 3 and min(counts) >= 0 and sum(counts) == int(header["bodies"]) > 0
