"""The particles of a file that are asked for, as a table of their own: what all of them have made stays with those that are left.

Flow: ParticleTable -> [selection] -> ParticleTable -> survey, snapshots.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from .assemble import in_box, kernel_of, particles_from_table
from .quantities import ROLES, choose_quantity
from .stored import stored_density, without_placeholder
from .table import ParticleTable, plain
from .where import select

ORIGIN = "support = "


def chosen(
    table: ParticleTable,
    quantity: str | None = None,
    support: float | None = None,
    kernel: str | None = None,
    *,
    box: Any = "file",
    where: str | None = None,
    share: float | None = None,
) -> ParticleTable:
    """Those particles of a table that are asked for; arguments as for `jaxsph.io.particles_from_table`.

    Supports, volumes and, where `quantity` needs it, the density are those that all particles have made, as columns.

    Raises:
        ValueError: as `particles_from_table`.
    """
    boxed, notes = in_box(table, box)
    if boxed.box_size is None:  # else it is said where particles are made
        boxed = dataclasses.replace(boxed, conventions=(*boxed.conventions, *notes))
    if where is None and share is None:
        return boxed
    stored = stored_density(boxed)
    boxed = without_placeholder(boxed, stored)
    particles, report = particles_from_table(boxed, "x", support, kernel)
    density = functools.cache(lambda: _density(boxed, support, kernel))
    kept, told = select(boxed, where, share, density=density)
    columns = dict(boxed.columns)
    if _is_density(boxed, choose_quantity(boxed, quantity, density=density)[1]):
        columns["density"] = density()
    said = [sentence for sentence in (*boxed.conventions, stored.told) if sentence and not sentence.startswith(ORIGIN)]
    name, why = kernel_of(boxed, kernel)
    own = particles.to_numpy()
    return dataclasses.replace(
        boxed,
        position=boxed.position[kept],
        columns={name: column[kept] for name, column in columns.items()},
        support=own["support"][kept],
        volume=own["volume"][kept],
        kernel=name,
        conventions=(
            *(sentence for sentence in said if not sentence.startswith("kernel =")),
            f"kernel = {why}",
            report.support if report.support.startswith(ORIGIN) else ORIGIN + report.support,
            *told,
        ),
    )


def _density(table: ParticleTable, support: float | None, kernel: str | None) -> np.ndarray:
    return particles_from_table(table, "density", support, kernel)[0].to_numpy()["quantity"].astype(np.float64)


def _is_density(table: ParticleTable, name: str) -> bool:
    """Whether a quantity is a density that the table does not hold."""
    return plain(name).endswith("density") and table.named(name.rpartition(":")[2], *ROLES["density"]) is None
