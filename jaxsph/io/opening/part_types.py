"""Types of particles of one file: which of those that are named there are, and several as one set, for what adds up.

Flow: path, types -> [part_types: read_types] -> a table of each -> [together] -> one ParticleTable -> columns, slices.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsph.io.damage import DataError, NoParticlesError, naming
from jaxsph.io.file_units import without_cosmology
from jaxsph.io.formats import find_format, read_with
from jaxsph.io.parsing import Columns
from jaxsph.io.settle.assemble import FROM_FILE, SETTLED, Settled, in_box
from jaxsph.io.settle.quantities import LEFT_OUT, choose_quantity, unit_of
from jaxsph.io.table import CodeUnit, ParticleTable, synonyms

OTHERS, WHICH = "also holds", "particles of PartType"  # first words of conventions on other types, and on the type that is read


class OfType(NamedTuple):
    """Particles of a type that was named, and the look that was asked for."""

    called: str
    look: str | None
    table: ParticleTable


def read_types(
    path: str | os.PathLike[str], types: Iterable[tuple[int | str | None, str | None]], physical: bool = False
) -> tuple[list[OfType], list[str]]:
    """Read each type that is named once, and say which names were left out: types without particles, and repetitions.

    Raises `ValueError`: what cannot be read; none of the types that are named has particles.
    """
    file, tables, said = Path(path), dict[Any, OfType](), list[str]()
    empty: NoParticlesError | None = None
    for kind, look in types:
        try:
            table = read_with(find_format(file), file, kind)
            if kind is not None and not len(table):
                raise NoParticlesError(f"{file}: has no particles of type {kind}; {table.said(OTHERS, 'and none of another')}")
        except NoParticlesError as error:
            empty = error
            said.append(f"there are no particles of type {kind}: the others are shown")
            continue
        if table.part_type in tables:
            said.append(f"type {kind} is {tables[table.part_type].called} once more, and is taken once")
            continue
        tables[table.part_type] = OfType(str(kind), look, without_cosmology(table) if physical else table)
    if not tables and empty is not None:
        raise empty
    return list(tables.values()), said


def read_together(
    path: str | os.PathLike[str],
    types: Iterable[tuple[int | str | None, str | None]],
    physical: bool = False,
    *settled: Any,
) -> ParticleTable:
    """The particles of all types that are named, as one set, see `together`, whose further arguments are `settled`."""
    each, said = read_types(path, types, physical)
    table = each[0].table if len(each) == 1 else together(each, *settled)
    return table.with_notes(*said)


def together(
    types: Sequence[OfType], support: float | str | None = None, kernel: str | None = None, box: Any = FROM_FILE
) -> ParticleTable:
    """Join several types to one set; supports, volumes and densities of each type are those among its own particles.

    What all types have is a column: masses are masses, whatever each type calls them. What one lacks, or has in another unit, is
    left out, which conventions say.

    Args:
        types: at least one, of one file.
        support, kernel, box: as `jaxsph.io.particles_from_table` takes them; the kernel is one for all.
    """
    first = types[0].table
    everywhere = np.concatenate([one.table.position for one in types])
    sides = in_box(ParticleTable(everywhere, box_size=first.box_size), box)[0].box_size
    own_kernel = next(filter(None, (one.table.kernel for one in types)), None)
    tables, parts, said = [], [], dict[str, None]()
    for called, _, table in types:
        with naming(f"type {called}"):
            settled = Settled(dataclasses.replace(table, box_size=sides, kernel=own_kernel), support, kernel)
            tables.append(_with_density(settled))
            parts.append((settled.support, settled.volumes()[0], f"{called}: {settled.origin.removeprefix('support = ')}"))
        own = (*table.conventions, settled.stored.told)
        said |= dict.fromkeys(one for one in own if one and not one.startswith((*SETTLED, OTHERS, WHICH)))
    weighed = [table.of_role("mass") is not None for table in tables]
    if any(weighed) and not all(weighed):
        without, of = types[weighed.index(False)].called, types[weighed.index(True)].called
        raise DataError(f"type {without} has no masses, and {of} has: they do not add up; leave one of them out")
    columns, units, left_out = _columns([one.called for one in types], tables)
    if isinstance(support, str) and all(table.support is not None for table in tables):
        columns["support"] = np.concatenate([table.support for table in tables])  # by which the expression is once more the same
    supports, volumes, origins = zip(*parts, strict=True)
    counts = ", ".join(f"{len(one.table):,} of {one.called}" for one in types)
    settling = f"support = {'; '.join(origins)}", "volume = that of each type by itself", f"kernel = {settled.kernel_told}"
    return dataclasses.replace(
        first,
        position=everywhere,
        columns=columns,
        support=np.concatenate(supports),
        volume=np.concatenate(volumes),
        conventions=(*said, f"types together: {counts}", *left_out, *settling),
        units=dataclasses.replace(first.units, columns=units),
        announced=None,
        unusable=None,
        kernel=settled.kernel,
    )


def _with_density(settled: Settled) -> ParticleTable:
    """Return the table with the density that its volumes are made of as a column, and the unit of that."""
    stored, table = settled.stored, settled.table
    name = table.of_role("density") or "density"
    is_summed = stored.column is None and bool(stored.told)
    values = settled.density() if is_summed else choose_quantity(table, "density", density=settled.density)[0]
    units: dict[str, Any] = {**table.units.columns, name: unit_of(table, "density")}
    return dataclasses.replace(
        table, columns={**table.columns, name: values}, units=dataclasses.replace(table.units, columns=units)
    )


def _columns(called: Sequence[str], tables: Sequence[ParticleTable]) -> tuple[Columns, dict[str, CodeUnit], list[str]]:
    """Join columns that all tables have, under the names of the first; return their units, and sentences on the others, too."""
    columns, units, joined = Columns(), dict[str, CodeUnit](), [set[str | None]() for _ in tables]
    for name in tables[0].columns:
        names = [table.named(name, *synonyms(name)) for table in tables]
        each = [table.columns[own] for table, own in zip(tables, names, strict=True) if own is not None]
        known = [table.units.columns.get(own or "") for table, own in zip(tables, names, strict=True)]
        stated = [unit for unit in known if unit is not None]
        kinds = {(unit.powers, unit.a, unit.h, f"{unit.cgs:.5e}") for unit in stated}
        if len(each) < len(tables) or len({column.shape[1:] for column in each}) > 1 or len(kinds) > 1:
            continue
        columns[name] = np.concatenate(each)
        units |= {name: stated[0]} if stated else {}
        for own, others in zip(names, joined, strict=True):
            others.add(own)
    said = []
    for one, table, own_names in zip(called, tables, joined, strict=True):
        left = [name for name in table.columns if name not in own_names]
        said += [f"{LEFT_OUT}{', '.join(left)}: of {one}, and not of all types in one unit"] if left else []
    return columns, units, said
