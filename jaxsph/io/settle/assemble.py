"""From a table to particles: settle quantity, supports and volumes, and report what was settled.

Flow: ParticleTable -> [assemble: particles_from_table] -> Particles, Report; [chosen] -> a table of some of them -> snapshots.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxsph.io.damage import DataError, naming
from jaxsph.io.file_units import between
from jaxsph.io.settle import supports
from jaxsph.io.settle.around import centre_of_mass
from jaxsph.io.settle.matching import drawn, evaluated, select
from jaxsph.io.settle.quantities import (
    LOG_PREFIX,
    choose_quantity,
    formulas_said,
    is_gas,
    passed_over,
    spreads,
    unit_of,
    without_logarithm,
)
from jaxsph.io.table import SMOOTHING_NAMES, ParticleTable, one_each, positive
from jaxsph.io.units import bare, written
from jaxsph.model.camera.directions import UP
from jaxsph.model.particles.kernels import by_name
from jaxsph.model.particles.particles import Particles
from jaxsph.numerics import checks
from jaxsph.numerics.rows import distinct, share_places

SPACINGS_OF_ROUNDING = 64  # of positions to float32, that all places are at most apart where it is why particles share them
ROUNDING_NOTED = 1e-3  # rounding of positions to float32, in units of the smallest support, from which it is worth a note
FROM_FILE = "file"
OF_FILE = "lengths are numbers in the unit of the file"
GIVEN = "given by the caller"
OUTSIDE = 1e-3  # of a side, how far positions may lie outside of a box that a file's header states: codes wrap them now and then
ONE_BY_ONE = 0.025  # of their extent, supports of fewer particles than have neighbours, as a few black holes
ROUNDING_REFUSED = 0.25
"""The same in units of the median support, from which a picture would show the rounding instead of the particles."""
AUTO = "auto"
SETTLED = "support =", "volume =", "kernel ="  # how conventions begin that are told where these are
EVENLY = "as particles lie evenly"
DEFAULT_KERNEL = "poly6"
FLAT = {
    2: "two-dimensional: all particles lie in a plane, so kernels are those of two dimensions, and densities a unit of area",
    1: "one-dimensional: all particles lie on a line, so kernels are those of one dimension, and densities a unit of length",
}
WHOLE, SUPPORTS, GLANCE = "whole", "supports", "glance"
GLANCED = 2**14  # particles of a glance, whose supports and sums take less time than reading a file


@dataclasses.dataclass(frozen=True)
class Report:
    """What was read and how it was understood; `str(report)` is for people.

    Attributes:
        source: file format.
        path: the file, or an empty string.
        num_particles: number of particles.
        quantity: name of the quantity.
        quantity_range: its smallest and largest value; NaN for an empty set.
        opacity_by: name of the quantity that extinction is looked up by, where that was asked for, or chosen; it may be the same.
        support: one sentence on where the supports come from.
        support_range: smallest and largest support radius, length units; NaN for an empty set.
        volume: one sentence on where the volumes come from.
        kernel: the smoothing kernel, and why it is that one.
        notes: further sentences: what was left out, periodic boxes, rounding.
        evenly: whether supports are chosen, as those of particles that lie about evenly.
        gas: whether they have what gas has, see `jaxsph.io.settle.quantities.is_gas`.
        up: which way is up, see `ParticleTable`.
    """

    source: str
    path: str
    num_particles: int
    quantity: str
    quantity_range: tuple[float, float]
    support: str
    support_range: tuple[float, float]
    volume: str
    notes: tuple[str, ...]
    opacity_by: str | None = None
    kernel: str = ""
    evenly: bool = False
    gas: bool = False
    up: tuple[float, float, float] = UP

    def __str__(self) -> str:
        lines = [
            f"{self.path or 'particles'}: {self.num_particles} particles ({self.source})",
            f"quantity  {self.quantity}: {self.quantity_range[0]:.6g} .. {self.quantity_range[1]:.6g}",
            *([] if self.opacity_by is None else [f"opacity   by {self.opacity_by}"]),
            f"support   {self.support_range[0]:.6g} .. {self.support_range[1]:.6g}: {self.support}",
            f"volume    {self.volume}",
            f"kernel    {self.kernel}",
        ]
        return "\n".join([*lines, *(f"note      {note}" for note in self.notes)])


def particles_from_table(
    table: ParticleTable,
    quantity: str | None = None,
    support: float | str | Float[np.ndarray, " particles"] | None = None,
    kernel: str | None = None,
    *,
    progress: bool = False,
    box: Any = FROM_FILE,
    where: str | None = None,
    share: float | None = None,
    opacity_by: str | None = None,
    effort: str = WHOLE,
) -> tuple[Particles, Report]:
    r"""Particles that carry a quantity of a table, or two: one for colour, one for extinction.

    Supports are `support` if given, else those of the table, else two spacings where particles lie evenly and are of one
    size, else the distance to the 32nd neighbour, or a part of the extent of fewer. Volumes are those of the table, else mass
    over density where a sample shows that to be the density
    (`jaxsph.io.settle.supports`), else $1 / \sum_j W(|x_i - x_j|, H_i)$.

    Args:
        table: what was read.
        quantity: name of a quantity (`jaxsph.io.settle.quantities`), or `None` for the most telling one.
        support: one support radius, or one a particle, in the table's length unit, or an expression of columns, as `"2*h"`;
            overrides the table's.
        kernel: for the particles and for kernel sums; `None` for the table's own, else poly6.
        box: (Lx, Ly, Lz), sides of a periodic box; "file" for that of the table, `None` for none.
        progress, where, share, opacity_by: as for `jaxsph.io.read_particles`.
        effort: what is found of all particles: `"whole"`; `"supports"`, but no volumes, which are 1; or `"glance"`, what some
            particles drawn at random have among all, and these are returned.

    Returns:
        The particles, and the report on what was settled. Particles are float32 unless the positions are float64 and
        x64 is enabled in JAX.

    Raises:
        ValueError: an unknown quantity; values that are not finite; supports that are not positive; positions whose
            float32 rounding exceeds a quarter of a support; a condition that is not understood, or that no particle meets.
    """
    with naming(table.path):
        return _assemble(*in_box(table, box), quantity, support, kernel, progress, (where, share, opacity_by), effort)


def in_box(table: ParticleTable, box: Any) -> tuple[ParticleTable, list[str]]:
    """The table with the periodic box asked for, and a note on that; radii are from the middle of all that it holds now."""
    boxed, notes = _in_box(table, box)
    if boxed.center is None:
        boxed = dataclasses.replace(boxed, center=functools.partial(centre_of_mass, boxed))
    return boxed, notes


def _in_box(table: ParticleTable, box: Any) -> tuple[ParticleTable, list[str]]:
    box = checks.plain("box", box, OF_FILE)
    sides = table.box_size if isinstance(box, str) else None if box is None else tuple(float(side) for side in box)
    if sides is None:
        return dataclasses.replace(table, box_size=None), []
    edges = " x ".join(f"{side:g}" for side in sides)
    if not (len(sides) == 3 and all(np.isfinite(side) and side > 0 for side in sides)):
        raise DataError(f"`box` must be three lengths > 0, got {edges}; give the sides of the period")
    low, high = (table.position.min(0), table.position.max(0)) if len(table) else (np.zeros(3), np.zeros(3))
    outside = (low < -OUTSIDE * np.array(sides)).any() or (high > (1 + OUTSIDE) * np.array(sides)).any()
    if isinstance(box, str) and outside:
        return dataclasses.replace(table, box_size=None), [f"not periodic: positions are outside of the file's box of {edges}"]
    return dataclasses.replace(table, box_size=sides), [f"periodic box of {edges}: supports reach across its faces"]


def chosen(
    table: ParticleTable,
    quantity: str | None = None,
    support: float | str | None = None,
    kernel: str | None = None,
    *,
    box: Any = FROM_FILE,
    where: str | None = None,
    share: float | None = None,
    volumes: bool = True,
) -> ParticleTable:
    """Those particles of a table that are asked for; arguments as for `particles_from_table`.

    Supports, `volumes` and, where `quantity` needs it, the density are those that all particles have made, as columns; of a share
    those that it has made, each particle in place of as many (`jaxsph.io.settle.matching.drawn`).
    """
    with naming(table.path):
        boxed, notes = in_box(table, box)
        if boxed.box_size is None:  # else it is said where particles are made
            boxed = boxed.with_notes(*notes)
        if (where or boxed.fluid) is None and share is None:
            return boxed
        settled = Settled(boxed, support, kernel, where=where, share=share)
        kept, told = settled.kept, (*settled.told, *formulas_said(boxed, where))
        boxed, dtype = settled.table, jax.dtypes.canonicalize_dtype(settled.table.position.dtype)  # as of particles

        def density() -> np.ndarray:
            return settled.density().astype(dtype).astype(np.float64)

        some, shown = boxed.rows(kept), quantity or choose_quantity(boxed, density=density)[1]
        columns = dict(some.columns)
        try:
            choose_quantity(some, shown)
        except DataError:
            choose_quantity(some, shown, density=lambda: density()[kept])  # which says what else may be wrong
            columns["density"] = density()[kept]  # that the table does not hold
        said = [one for one in (*boxed.conventions, settled.stored.told) if one and not one.startswith(SETTLED)]
        origin = settled.origin.removeprefix("support = ")
        return dataclasses.replace(
            some,
            columns=columns,
            support=settled.support[kept].astype(dtype),
            volume=_scaled(settled.volumes()[0])[kept].astype(dtype) if volumes or boxed.volume is not None else None,
            kernel=settled.kernel,
            conventions=(*said, f"kernel = {settled.kernel_told}", f"support = {origin}", *told),
        )


class Settled:
    """A table without what is no density, with supports, kernel and volumes, and a sentence on each; and who of it is shown.

    Of a share the table is what is drawn of it, of a `glance` some particles, of which supports and sums are those among all.
    """

    def __init__(
        self,
        table: ParticleTable,
        support: Any,
        kernel: str | None,
        progress: bool = False,
        *,
        where: str | None = None,
        share: float | None = None,
        glance: bool = False,
    ):
        where = where or table.fluid
        self.stored = supports.stored_density(table)
        self.told: tuple[str, ...] = ()
        some, kept, rows, at = table, None, None, None
        if self.stored.placeholder is not None:  # so that densities are sums whatever they are asked for by
            left = {name: column for name, column in table.columns.items() if name != self.stored.placeholder}
            some = dataclasses.replace(table, columns=left)
        among = some
        if share is not None:
            among, rows, kept, self.told = drawn(some, where, share)
            some = among
        elif glance and len(table) > GLANCED and (table.support is None or (table.volume is None and self.stored.column is None)):
            rows = at = np.sort(np.random.default_rng(0).choice(len(table), GLANCED, replace=False))
            some = some.rows(rows)
            self.told = (f"a glance at {GLANCED:,} of {len(table):,} particles: ranges are theirs; pictures look at all",)
        self.table = some
        if support is None:
            self.support, self.origin = _supports(table, among, rows, at, progress)
        else:
            given, self.origin = _given_supports(table, support)
            self.support = given if rows is None else given[rows]
        said = f"{DEFAULT_KERNEL}, as the file says nothing of kernels"
        if table.kernel is not None:
            said = table.said("kernel =", f"kernel = {table.kernel}").removeprefix("kernel = ")
        self.kernel, self.kernel_told = kernel or table.kernel or DEFAULT_KERNEL, f"{kernel}, {GIVEN}" if kernel else said
        self.mass_name = some.of_role("mass")
        mass = None if self.mass_name is None else among.stands_for * among.exact(self.mass_name)
        self.mass = mass if mass is None or at is None else mass[at]
        self._alike = mass is not None and len(mass) > 0 and mass.min() == mass.max()
        self.rounding = rounding_note(some.position, self.support)
        more: dict[str, Any] = {"kernel": self.kernel, "box": table.box_size, "progress": progress, "at": at}
        place = among.position, self.support
        self.thickness: Any = by_name(self.kernel).thickness(table.dimensions, self.support)
        self._sums = functools.cache(
            lambda by_mass=False: supports.kernel_sum(*place, mass if by_mass else None, **more) * self.thickness
        )
        if kept is None:
            kept, told = select(some, where, density=self.density)
            self.told = *self.told, *told
        self.kept = kept

    def density(self) -> np.ndarray:
        """The sum of kernels, times masses where there are any."""
        if self.mass is None:
            return self.table.stands_for * self._sums()
        return self.mass * self._sums() if self._alike else self._sums(True)

    def volumes(self) -> tuple[np.ndarray, str]:
        """Volumes, in a plane areas, and one sentence on where they come from."""
        if self.table.volume is not None:
            return self.table.volume.astype(np.float64), self.table.said("volume =", "as the file has it")
        if self.mass is None or self.stored.column is None:
            return 1 / self._sums(), "1 / sum of kernels within the particle's own support"
        measured = f" (the stored density is {self.stored.measured})" if self.stored.measured else ""
        volumes = self.mass / supports.density_as_summed(self.table, self.stored.column)
        return volumes, f"{self.mass_name} / {self.stored.column}{measured}"


def _assemble(
    table: ParticleTable,
    notes: list[str],
    quantity: str | None,
    support: float | str | np.ndarray | None,
    kernel: str | None,
    progress: bool,
    wanted: tuple[str | None, float | None, str | None],
    effort: str,
) -> tuple[Particles, Report]:
    condition, share, opacity = wanted
    condition = condition or table.fluid
    settled = Settled(table, support, kernel, progress, where=condition, share=share, glance=effort == GLANCE)
    table, kept = settled.table, settled.kept
    notes = [*(sentence for sentence in table.conventions if not sentence.startswith(SETTLED)), *notes]
    notes += [settled.stored.told] if settled.stored.told else []
    if condition is None or quantity is None:
        values, name = choose_quantity(table, quantity, density=settled.density)
        values = values[kept]
    else:  # those that are left out may have no value
        values, name = choose_quantity(table.rows(kept), quantity, density=lambda: settled.density()[kept])
    notes += passed_over(table, name) if quantity is None else []
    volumes, volume_origin = (np.ones(len(table)), "") if effort == SUPPORTS else settled.volumes()
    if re.search(r"\bdensity\b", name) and table.of_role("density") is None:
        notes.append("density = sum of kernels" + (" times mass" if settled.mass is not None else ", as there are no masses"))
    notes += [settled.rounding] if settled.rounding else []
    notes += places_note(table.position)
    notes += [FLAT[table.dimensions]] if table.dimensions in FLAT else []
    dtype = table.position.dtype
    notes += [*settled.told, *formulas_said(table, name, opacity, condition)]
    second, opacity_by = _opacity(settled, name, opacity, volumes)
    notes += without_logarithm(table, settled.density, kept, name, opacity_by)
    own = {"support": settled.support, "volume": _scaled(volumes * settled.thickness), "second": second}
    with np.errstate(over="ignore"):
        columns: dict[str, Any] = {role: column[kept].astype(dtype) for role, column in own.items() if column is not None}
        columns["quantity"] = values.astype(dtype)
        if second is not None:
            columns["quantity"] = columns["quantity"], columns.pop("second")
        particles = Particles.from_arrays(table.position[kept], **columns, kernel=settled.kernel, box=table.box_size)
    length = table.units.length
    particles = particles if length is None else dataclasses.replace(particles, length_unit=written(length))
    report = Report(
        source=table.source,
        path=table.path,
        num_particles=int(kept.sum()),
        quantity=name,
        quantity_range=range_of(values),
        support=settled.origin,
        support_range=range_of(settled.support[kept]),
        volume=volume_origin,
        notes=tuple(notes),
        opacity_by=opacity_by,
        kernel=settled.kernel_told,
        evenly=settled.origin.endswith(EVENLY),
        gas=is_gas(table),
        up=table.up,
    )
    return particles, report


def _opacity(settled: Settled, color_by: str, wanted: str | None, volumes: np.ndarray) -> tuple[np.ndarray | None, str | None]:
    """What extinction is looked up by, None where it is the quantity itself, and its name; where that is chosen, by densities."""
    table, mass, name = settled.table, settled.mass, settled.table.of_role("density")
    if wanted == AUTO:
        thinness = volumes if mass is None else volumes / mass
        if name is not None and table.volume is None and supports.is_positive(table.columns[name]):
            thinness = 1 / table.exact(name)  # that which would be looked up, whatever volumes are of
        wanted = f"{LOG_PREFIX}{name or 'density'}" if spreads(thinness) else None
    if wanted is None:
        return None, None
    values, full_name = choose_quantity(table, wanted, density=settled.density)
    return None if full_name == color_by else values, full_name


def _given_supports(table: ParticleTable, support: float | str | np.ndarray) -> tuple[np.ndarray, str]:
    said = f"{support}, " if isinstance(support, str) else ""
    if isinstance(support, str):
        support = bare(support, "support", table.units.length)
        support = evaluated(table, support, "support") * between(unit_of(table, support), table.units.length, table.units)
    support = checks.plain("support", support, OF_FILE)
    return positive("support", one_each("support", support, len(table)), "give a radius"), f"{said}{GIVEN}"


def _supports(
    table: ParticleTable, among: ParticleTable, rows: np.ndarray | None, at: np.ndarray | None, progress: bool
) -> tuple[np.ndarray, str]:
    """Supports `among` particles of a table, which may be some of its `rows`, of all or of those `at` some places."""
    if among.support is not None:
        return (among.support if at is None else among.support[at]).astype(np.float64), among.said(
            "support =", "as the file has it"
        )
    if table.unusable is not None:
        raise DataError(table.unusable)
    own = table.named(*SMOOTHING_NAMES)  # where these differ, particles are of several sizes
    differ = own is not None and spreads(table.columns[own], supports.EVEN)
    spacing = None if differ else supports.even_spacing(table.position, box=table.box_size, quick=rows is not None)
    if spacing is not None:
        spacing *= among.stands_for ** (1 / table.dimensions)
        count = len(among if at is None else at)
        return np.full(count, supports.SPACINGS * spacing), f"{supports.SPACINGS:g} spacings of {spacing:.4g}, {EVENLY}"
    neighbours = round(supports.neighbours_in(supports.NEIGHBOURS, table.dimensions))
    origin = f"distance to neighbour {neighbours}"
    if len(among) == 1:
        origin = "1, as a single particle has no neighbours"
    elif len(among) and not np.ptp(among.position, axis=0).any():
        origin = "1, as all particles are at one place"
    elif 0 < len(among) <= neighbours:
        size = ONE_BY_ONE * float(np.ptp(among.position, axis=0).max())
        few = f"{len(among)} are fewer than the {neighbours} neighbours of a support"
        return np.full(len(among), size), f"{100 * ONE_BY_ONE:g} % of their extent, as {few}"
    reach = supports.nearest_neighbour_supports(among.position, neighbours, box=table.box_size, progress=progress, at=at)
    if table.box_size is not None and reach.max(initial=0) > (most := min(table.box_size) / 2):
        return np.minimum(reach, most), f"{origin}, at most half of the box"
    return reach, origin


def _scaled(volumes: np.ndarray) -> np.ndarray:
    """Volumes over their median where float32 could not hold them: only their ratios matter."""
    limits = np.finfo(np.float32)
    fits = len(volumes) == 0 or (volumes.max() < np.sqrt(limits.max) and volumes.min() > np.sqrt(limits.tiny))
    return volumes if fits else volumes / np.median(volumes)


def places_note(position: np.ndarray) -> list[str]:
    """A note on particles of which many share a place, and whether rounding to float32 may be why."""
    if not share_places(position):
        return []
    places = position[distinct(position)[0]].astype(np.float64)
    told = f"{len(position):,} particles share {len(places):,} place{'' if len(places) == 1 else 's'}"
    rounding = np.abs(places).max() * float(np.finfo(np.float32).eps)
    if position.dtype != np.float64 and np.ptp(places, axis=0).max() <= SPACINGS_OF_ROUNDING * rounding:
        told += f", as float32 holds positions that reach {np.abs(places).max():.4g} to {rounding:.2g}: write them in float64"
    return [told]


def rounding_note(position: np.ndarray, support: np.ndarray, called: str = "supports") -> str | None:
    """A note on what float32 has done to the positions; `ValueError` where it has destroyed them. float64 ones stay whole."""
    if len(position) == 0 or position.dtype == np.float64:
        return None
    rounding = float(np.abs(position).max()) * float(np.finfo(np.float32).eps) / 2
    typical = float(np.median(support))
    if rounding > ROUNDING_REFUSED * typical:
        raise DataError(
            f"positions reach {np.abs(position).max():.6g} with {called} of {typical:.6g}: float32 has rounded them by "
            f"{rounding / typical:.2g} of them; give them in float64, or subtract a common offset before they become float32"
        )
    if rounding > ROUNDING_NOTED * float(support.min()):
        return f"float32 has rounded positions by up to {rounding / float(support.min()):.2g} of the smallest of the {called}"
    return None


def range_of(values: np.ndarray) -> tuple[float, float]:
    """Smallest and largest; NaN of nothing."""
    return (float(values.min()), float(values.max())) if len(values) else (float("nan"), float("nan"))
