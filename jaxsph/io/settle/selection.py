"""The particles of a file that are asked for, as a table of their own: what all of them have made stays with those that are left.

Flow: ParticleTable -> [selection] -> ParticleTable -> survey, snapshots.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from jaxsph.io.settle.assemble import in_box, kernel_of, particles_from_table
from jaxsph.io.settle.quantities import ROLES, choose_quantity
from jaxsph.io.settle.stored import stored_density, without_placeholder
from jaxsph.io.settle.where import select
from jaxsph.io.table import ParticleTable, plain

ORIGIN = "support = "


def chosen(
    table: ParticleTable,
    quantity: str | None = None,
    support: float | str | None = None,
    kernel: str | None = None,
    *,
    box: Any = "file",
    where: str | None = None,
    share: float | None = None,
) -> ParticleTable:
    """Those particles of a table that are asked for; arguments as for `jaxsph.io.particles_from_table`.

    Supports, volumes and, where `quantity` needs it, the density are those that all particles have made, as columns.

    Raises `ValueError`: as `particles_from_table`.
    """
    boxed, notes = in_box(table, box)
    if boxed.box_size is None:  # else it is said where particles are made
        boxed = dataclasses.replace(boxed, conventions=(*boxed.conventions, *notes))
    if where is None and share is None:
        return boxed
    stored = stored_density(boxed)
    boxed = without_placeholder(boxed, stored)
    particles, report = particles_from_table(boxed, "x", support, kernel)

    @functools.cache
    def density() -> np.ndarray:
        return particles_from_table(boxed, "density", support, kernel)[0].to_numpy()["quantity"].astype(np.float64)

    kept, told = select(boxed, where, share, density=density)
    columns = dict(boxed.columns)
    shown = choose_quantity(boxed, quantity, density=density)[1]
    if plain(shown).endswith("density") and boxed.named(shown.rpartition(":")[2], *ROLES["density"]) is None:
        columns["density"] = density()  # that the table does not hold
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
