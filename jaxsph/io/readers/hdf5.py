r"""HDF5 files: by content it is found out which code wrote one.

| inside | read as |
|---|---|
| `PartType0`, `PartType1`, ... | Gadget-style snapshots (GADGET-2/3/4, GIZMO, AREPO, SWIFT), one type of particles |
| `particles/xyz` and `header` | Phantom (`phantom`) |
| `particles/NAME/arrays` | PySPH, whose sets of particles are types by name; without boundaries, unless they are asked for |
| `Coordinates` or `position`, or `x`, `y` and `z`, at the top | plain points |

What `SmoothingLength` means depends on the code:

| code | support radius $H$ |
|---|---|
| GADGET, GIZMO | `SmoothingLength` itself |
| SWIFT | $\gamma$ `SmoothingLengths`, with $\gamma$ of the kernel and the dimension named in `HydroScheme` |

Units are left as stored (comoving, with factors of the Hubble parameter, where the code does so). Masses come from
`Masses`, or from `MassTable` in the header. A box is periodic, unless the file says otherwise: GADGET-4 in the group `Config`,
SWIFT in `Parameters`. The kernel is that which SWIFT (`HydroScheme`), GADGET-4 (`Config`) or GIZMO (`Kernel_Function_ID`) state;
a cubic spline where nothing is said.
Sources: Springel et al. 2021 (GADGET-4), section 7; Schaller et al. 2024 (SWIFT), table 1, after Dehnen & Aly 2012.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, NoParticlesError
from jaxsph.io.file_units import attributes_of, between, number_of, numbers_of, of_gadget
from jaxsph.io.parsing import COORDINATES, TYPE_NUMBERS, choose_type, gather_vectors, others_held, type_number
from jaxsph.io.readers import phantom
from jaxsph.io.readers.hdf5_guards import (
    columns_beside,
    followed,
    holds,
    member,
    members,
    opened,
    read_positions,
    refuse_unwritten,
    shape_of,
)
from jaxsph.io.snapshot_files import concatenated
from jaxsph.io.table import (
    GEOMETRY,
    POSITION_NAMES,
    ROLES,
    ParticleTable,
    box_of,
    called,
    plain,
    scalar_of_width_one,
    table_from_columns,
    usable_supports,
)

SOURCE, SWIFT_SOURCE, POINTS_SOURCE = "Gadget HDF5", "SWIFT HDF5", "HDF5 points"
SWIFT_KERNELS = {
    "Cubic spline (M4)": ("cubic_spline", (1.732051, 1.778002, 1.825742)),
    "Quartic spline (M5)": ("quartic_spline", (1.936492, 1.977173, 2.018932)),
    "Quintic spline (M6)": ("quintic_spline", (2.121321, 2.158131, 2.195775)),
    "Wendland C2": ("wendland_c2", (1.620185, 1.897367, 1.936492)),
    "Wendland C4": ("wendland_c4", (1.936492, 2.171239, 2.207940)),
    "Wendland C6": ("wendland_c6", (2.207940, 2.415230, 2.449490)),
}
"""Kernels, and support radius over smoothing length in one, two and three dimensions: SWIFT defines $h$ as twice the standard
deviation of the kernel; of one dimension, Wendland's are others."""
GADGET4_KERNELS = {
    f"{name.upper()}_KERNEL": name for name in ("cubic_spline", "wendland_c2", "wendland_c4", "wendland_c6")
}  # what GADGET-4 was compiled with, in the group `Config`; a cubic spline where it names none
GIZMO_KERNELS = {
    3: "cubic_spline",
    4: "quintic_spline",
    5: "quartic_spline",
    6: "wendland_c2",
    7: "wendland_c4",
    9: "wendland_c6",
}
"""By `Kernel_Function_ID` in the header, its KERNEL_FUNCTION, as its `kernel.h` evaluates them: what that calls quartic (4) has
the fifth powers and the norm of M6, what it calls quintic (5) those of M5."""
MOVING_MESH = {"VORONOI", "VORONOI_DYNAMIC_UPDATE", "VORONOI_STATIC_MESH"}
MESH_NOTE = (
    "the cells of a moving mesh (AREPO) are read as SPH particles at their mesh-generating points: volumes are the cells' "
    "own, mass / density, and supports reach 32 neighbours, so that the field is smoother than the cells"
)
BOUNDARIES = "bound", "solid", "wall", "tank", "obstacle", "ghost"  # in names of PySPH's sets
CUBIC = "cubic_spline"
SMOOTHING_NAMES = ("smoothinglength", "smoothinglengths", "hsml")
NEEDED = {*SMOOTHING_NAMES, *map(plain, (*ROLES["mass"], *ROLES["density"], *GEOMETRY))}
"""Columns whose absence would change supports or volumes."""


def read(path: Path, *, part_type: int | str | None = None) -> ParticleTable:
    """Read an HDF5 file of any of the flavours at the top of this module."""
    with opened(path) as file:
        if any(name.startswith("PartType") for name in file) or "NumPart_ThisFile" in attributes_of(file, "Header"):
            return gadget(file, part_type)
        if "header" in file and "particles" in file and "xyz" in file["particles"]:
            return phantom.from_hdf5(file, part_type)
        sets = {name: followed(each, "arrays") for name, each in _groups(file.get("particles")).items() if _groups(each)}
        if any(map(_groups, sets.values())):
            return _pysph(file, {name: group for name, group in sets.items() if group}, part_type)
        stored = called(file, POSITION_NAMES)
        first = stored or called(file, COORDINATES)
        if first is None:
            wrong = f"is HDF5 with {', '.join(file) or 'nothing'} at its top; expected `PartType0` (Gadget,"
            raise DataError(f"{wrong} SWIFT), `particles` and `header` (Phantom), or a dataset `Coordinates`")
        if part_type is not None:
            raise DataError(f"holds plain points without particle types; leave out `part_type` (got {part_type})")
        needed = {*NEEDED, *COORDINATES} - {*SMOOTHING_NAMES}
        if stored is None:
            position, columns, said = _flat(file, first, needed)
        else:
            position = read_positions(file[stored])
            columns, said = columns_beside(stored, file, len(position), needed)
        return table_from_columns(position, columns, source=POINTS_SOURCE, conventions=said)


def _groups(item: Any) -> dict[str, Any]:
    """What a group holds; nothing of what is none."""
    return members(item) if hasattr(item, "keys") else {}


def _flat(group: Any, first: str, needed: set[str]) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    """Positions of x, y and z, of as many rows as the `first` has, the other columns, and sentences on those left out."""
    columns, said = columns_beside("", group, math.prod((shape_of(member(group, first)) or ())[:1]), needed)
    columns = {name: scalar_of_width_one(column) for name, column in columns.items()}
    return *gather_vectors(columns, others=group), said


def _pysph(file: Any, sets: dict[str, Any], part_type: int | str | None) -> ParticleTable:
    """The particles of one set by its name, or of all that are no boundaries."""
    if part_type is not None and part_type not in sets:
        raise NoParticlesError(f"has no particles called {part_type}; `part_type` can be {', '.join(sets)}")
    free = [name for name in sets if not any(word in name.lower() for word in BOUNDARIES)] or list(sets)
    chosen, tables = free if part_type is None else [str(part_type)], []
    for name in chosen:
        position, columns, said = _flat(sets[name], "x", {*NEEDED, *"xyz"} - {*SMOOTHING_NAMES})
        if all(axis in columns for axis in "uvw"):
            columns["velocity"] = np.stack([columns.pop(axis) for axis in "uvw"], 1)
        columns = {"internal_energy" if each == "e" else each: column for each, column in columns.items()}
        tables.append(table_from_columns(position, columns, source="PySPH", conventions=said))
    table = concatenated(tables, 1)
    others = [name for name in sets if name not in chosen]
    left_out = [f"also holds {', '.join(others)}: `part_type=` or --part-type reads one"] if others else []
    said = [f"particles of {', '.join(chosen)}", *left_out, *table.conventions]
    time = number_of(attributes_of(file, "solver_data"), "t")
    return dataclasses.replace(table, conventions=tuple(said), time=time)


def gadget(file: Any, part_type: int | str | None) -> ParticleTable:
    """The particles of one type of an open `h5py.File`.

    Without `part_type` that is type 0 (gas), or another that has `Coordinates`, see `choose_type`.
    """
    swift = any("SWIFT" in text(attributes_of(file, part).get("Code", "")) for part in ("Header", "Code"))
    (chosen, group), present = _choose(file, type_number(part_type, TYPE_NUMBERS | {"sinks": 3} if swift else TYPE_NUMBERS))
    position = read_positions(group["Coordinates"])
    count = len(position)
    header, config = attributes_of(file, "Header"), set(attributes_of(file, "Config"))
    stated = numbers_of(header, "NumPart_ThisFile")  # a file that was rewritten in part, or not to its end, says so here alone
    if chosen < len(stated) and stated[chosen] != count:
        wrong = f"has {count} particles of type {chosen}, but `NumPart_ThisFile` in its header says {stated[chosen]:g};"
        raise DataError(f"{wrong} copy it again, or correct that number if rows were added or left out on purpose")
    counts = _counts(header, present)
    columns, left_out = columns_beside("Coordinates", group, count, NEEDED)
    said = [f"particles of PartType{chosen}", *others_held(counts, chosen), *left_out]
    masses = numbers_of(header, "MassTable")
    if not any(plain(name) in ("mass", "masses") for name in columns) and chosen < len(masses):
        mass, where = float(masses[chosen]), "`MassTable` of its header; correct that number there"
        if not 0 <= mass < np.inf:
            raise DataError(f"has mass {mass:g} for particles of type {chosen} in {where}")
        if mass:
            columns["Masses"] = np.full(count, mass)
            said.append(f"mass = {mass:g} for all (MassTable in the header)")
    of_swift = text(attributes_of(file, "HydroScheme").get("Kernel function", "")) if swift else None
    units = of_gadget(file, group, swift)
    smoothing = called(columns, SMOOTHING_NAMES)
    support = unusable = None
    if smoothing is not None:
        support, sentence = _support(file, columns[smoothing], smoothing, of_swift)
        if (factor := between(units.columns.get(smoothing), units.length, units)) != 1:
            support, sentence = factor * support, f"{sentence}, times {factor:.6g} as positions are in another unit"
        support, unusable = usable_supports(support)
        said.append(sentence)
    of_mesh = any(name == "CenterOfMass" or name.startswith("GFM_") for name in group)  # its family alone writes these
    if smoothing is None and chosen == 0 and (config & MOVING_MESH or of_mesh):
        said.append(MESH_NOTE)
    kernel, sentence = _kernel(header, config, of_swift)
    said.append(sentence)
    edges = numbers_of(header, "BoxSize").astype(np.float64)
    box_size, notes = box_of(edges) if _is_periodic(file, config) and edges.any() else (None, [])
    said += notes
    source = SWIFT_SOURCE if swift else SOURCE
    more: dict[str, Any] = {"conventions": tuple(said), "units": units, "time": number_of(header, "Time")}
    more |= {"part_type": chosen, "num_files": max(int(number_of(header, "NumFilesPerSnapshot") or 1), 1), "kernel": kernel}
    more |= {"announced": counts[chosen], "unusable": unusable}
    return ParticleTable(position, columns, support, None, box_size, source, **more)


def _choose(file: Any, part_type: int | None) -> tuple[tuple[int, Any], list[int]]:
    """The type that is read and its group, and all types that can be."""
    groups = {int(m[1]): followed(file, name) for name in file if (m := re.fullmatch(r"PartType(\d+)", name))}
    usable = sorted(number for number, group in groups.items() if group is None or holds(group, "Coordinates"))
    if not usable:
        raise NoParticlesError("has no type of particles with Coordinates; write the snapshot again with positions")
    table = numbers_of(attributes_of(file, "Header"), "MassTable")
    masses = {number: float(table[number]) for number in usable if number < len(table) and table[number] > 0}
    filled = usable
    if part_type is None:  # a type whose group is empty is passed over
        masses |= {
            number: mass for number in usable if number not in masses and (mass := _first_mass(groups[number])) is not None
        }
        places = {number: followed(groups[number], "Coordinates") for number in usable if groups[number] is not None}
        filled = [number for number in usable if (shape_of(places.get(number)) or (1,))[0]]
    chosen = choose_type(filled or usable, part_type, mass=masses)
    member(file, f"PartType{chosen}")
    member(groups[chosen], "Coordinates")
    return (chosen, groups[chosen]), usable


def _first_mass(group: Any) -> float | None:
    """The mass of the first particle of a group, which stands for all, where each has its own and it can be read."""
    column = called(group or (), ROLES["mass"])
    with contextlib.suppress(DataError):
        each = None if column is None else member(group, column)
        if (shape_of(each) or (0,))[0]:
            refuse_unwritten(each)
            return float(each[0])  # type: ignore[index]
    return None


def _counts(header: Any, present: list[int]) -> dict[int, int | None]:
    """How many particles of each type the whole snapshot has, as its header says; `None` of those `present` that it does not."""
    counts: dict[int, int | None] = dict.fromkeys(present)
    for name, factor in (("NumPart_Total", 1), ("NumPart_Total_HighWord", 2**32)):
        for number, count in enumerate(numbers_of(header, name).tolist()):
            counts[number] = (counts.get(number) or 0) + int(count) * factor
    return counts


def _support(file: Any, smoothing: np.ndarray, name: str, kernel: str | None) -> tuple[np.ndarray, str]:
    if kernel is None:
        return smoothing, f"support = {name} (Gadget convention: the kernel ends there)"
    if kernel not in SWIFT_KERNELS:
        wrong = f"is a SWIFT snapshot with kernel {kernel!r} (HydroScheme, `Kernel function`);"
        raise DataError(f"{wrong} the support radius is known for {', '.join(SWIFT_KERNELS)}")
    stated = (number_of(attributes_of(file, part), "Dimension") for part in ("HydroScheme", "Header"))
    dimensions = next((int(number) for number in stated if number in (1, 2, 3)), 3)
    gamma = SWIFT_KERNELS[kernel][1][dimensions - 1]
    of = f"{kernel} kernel" + f" in {dimensions}-D" * (dimensions < 3)
    return gamma * smoothing.astype(np.float64), f"support = {gamma} x {name} (SWIFT convention, {of})"


def _kernel(header: Any, config: set[str], stated: str | None) -> tuple[str, str]:
    """The smoothing kernel, and one sentence on where that is said."""
    if stated in SWIFT_KERNELS:
        return SWIFT_KERNELS[stated][0], f"kernel = {SWIFT_KERNELS[stated][0]} (SWIFT's {stated}, HydroScheme)"
    if config & MOVING_MESH:
        return CUBIC, f"kernel = {CUBIC}: the cells of a moving mesh (AREPO) have none, and are drawn as particles"
    compiled = [name for name in GADGET4_KERNELS if name in config]
    if compiled:
        return GADGET4_KERNELS[compiled[0]], f"kernel = {GADGET4_KERNELS[compiled[0]]} ({compiled[0]}, Config)"
    number = number_of(header, "Kernel_Function_ID")
    if number is not None and int(number) in GIZMO_KERNELS:
        kernel = GIZMO_KERNELS[int(number)]
        return kernel, f"kernel = {kernel} (GIZMO's Kernel_Function_ID {int(number)})"
    if number is not None:
        return CUBIC, f"kernel = {CUBIC}: GIZMO's Kernel_Function_ID {number:g} is none that is known here"
    return CUBIC, f"kernel = {CUBIC} (of Gadget-like codes unless told otherwise; the file does not say)"


def _is_periodic(file: Any, config: set[str]) -> bool:
    """Whether the box of a snapshot is periodic, as far as it says: else it is."""
    if config:
        return "PERIODIC" in config
    return text(attributes_of(file, "Parameters").get("InitialConditions:periodic", "")).strip() != "0"


def text(value: Any) -> str:
    """An HDF5 attribute as a string, whether it is stored as one, as bytes, or as an array of one of them."""
    first = np.ravel(np.asarray(value, dtype=object))
    if len(first) == 0:
        return ""
    return first[0].decode("utf-8", errors="replace") if isinstance(first[0], bytes) else str(first[0])
