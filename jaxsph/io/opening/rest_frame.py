"""Velocities less that of the whole, or of its densest region: what is left when the bulk velocity is taken out.

Flow: ParticleTable, frame -> [rest_frame: in_frame] -> ParticleTable -> conditions, quantities, arrows.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxsph.io.settle.around import away_from
from jaxsph.io.settle.assemble import FROM_FILE, GLANCED, in_box
from jaxsph.io.settle.quantities import velocity_name
from jaxsph.io.settle.supports import nearest_neighbour_supports
from jaxsph.io.table import ParticleTable

FRAMES = "densest", "mass", "none"
REGION, FEWEST = 0.01, 32  # share of particles that the densest region has, and how many at least


def in_frame(table: ParticleTable, frame: str | None, box: Any = FROM_FILE) -> ParticleTable:
    """The table with velocities relative to their mean by mass, of all (`"mass"`) or of the densest region (`"densest"`).

    That is the hundredth of all particles, at least 32, which is nearest to the one whose neighbours are nearest, also across
    the faces of a `box`, as `particles_from_table` takes it.

    Raises `ValueError`: particles without velocities.
    """
    if frame in (None, "none") or not len(table):
        return table
    name, mass = velocity_name(table), table.masses()
    if name is None:
        raise ValueError(f"`frame` = {frame!r} needs velocities, and {table.path or 'the table'} has none; leave it out")
    rows, of = np.arange(len(table)), "all"
    if frame == "densest":
        sample = rows if len(rows) <= GLANCED else np.random.default_rng(0).choice(rows, GLANCED, replace=False)
        boxed = in_box(table, box)[0]
        reach = nearest_neighbour_supports(table.position, box=boxed.box_size, at=sample)
        place = table.position[sample[reach.argmin()]].astype(np.float64)
        number = min(len(rows), max(FEWEST, round(REGION * len(rows))))
        rows = np.argsort(np.linalg.norm(away_from(boxed, place), axis=1), kind="stable")[:number]
        of = f"the {number:,} particles nearest to {' '.join(f'{value:.6g}' for value in place)}, where they are densest"
    velocity = table.exact(name)
    bulk = np.average(velocity[rows], axis=0, weights=None if mass is None or not mass[rows].sum() > 0 else mass[rows])
    note = f"`{name}` is relative to {' '.join(f'{value:.6g}' for value in bulk)}, the mean by mass of {of}"
    return dataclasses.replace(table, columns={**table.columns, name: velocity - bulk}, conventions=(*table.conventions, note))
