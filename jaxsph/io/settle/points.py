"""From a file to points: settle radii, colours and extinctions, and report what was settled.

Flow: file -> [read_table] -> ParticleTable -> [points] -> Points, PointsReport; of a type beside another -> [glow] -> Points.

| of a point | taken from, in this order |
|---|---|
| radius | `radius`, `rad`, `r` (not beside `g` and `b`), `size`, a stored support, a smoothing length |
| colour | `r g b`, `red green blue`, `color_r ...`, a vector `color` or `rgb`; else white |
| strength | `extinction`, `opacity`, `alpha`; else an opacity of 0.8 |
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.damage import DataError, naming
from jaxsph.io.settle.assemble import GIVEN, OF_FILE, range_of, rounding_note
from jaxsph.io.settle.quantities import choose_quantity
from jaxsph.io.settle.supports import nearest_neighbour_supports
from jaxsph.io.table import SMOOTHING_NAMES, SUPPORT_NAMES, ParticleTable, called, one_each, positive, refuse_rows
from jaxsph.model.image import COLORS, rgb
from jaxsph.model.points import Points
from jaxsph.model.transfer.maps import colormap as colors_of_map, colors_at, value_range
from jaxsph.numerics import checks
from jaxsph.numerics.names import did_you_mean

RADIUS_NAMES = ("radius", "radii", "rad", "r", "size")
COLOR_TRIPLES = (("r", "g", "b"), ("red", "green", "blue"), ("color_r", "color_g", "color_b"))
COLOR_NAMES = ("color", "colour", "colors", "colours", "rgb", "rgba")
EXTINCTION_NAMES = ("extinction",)
OPACITY_NAMES = ("opacity", "alpha")
OPACITY = 0.8  # of a point through its centre, where nobody says
OPAQUE = 0.999  # what stands for an opacity of 1, which no extinction has
BYTE = 255
MARKERS = 1000  # so few of a type are marks for the eye, more are a glow
MARK = 0.015  # radius of a mark, over the extent of what it lies in
WIDEST = 0.05  # radius of what glows, over the same: what lies alone far outside is dim, and would cost most
BRIGHT, GLOW = 99.0, 2.0  # percentile of columns that has this optical depth
CELLS = 64  # of a side of the columns that are looked at
FOURIER = 0.57  # integral of a Gaussian profile over its ball, over the cube of the radius
HALOES = "dm", "halo", "1"
GLOWS = dict.fromkeys(HALOES, "#6a8cff") | {"disk": "#ffd9a0", "bulge": "#ffc070", "dust": "#d8a070"}
"""Colours of types that say none; others are white."""
REMEDY = "remove these points, or give `radius=NUMBER`"


@dataclasses.dataclass(frozen=True)
class PointsReport:
    """What was read and how it was understood; `str(report)` is for people.

    Attributes:
        source, path, notes: as of `Report` of particles.
        num_points: number of points.
        radius: one sentence on where the radii come from.
        radius_range: smallest and largest radius, length units; NaN for an empty set.
        color: one sentence on where the colours come from.
        strength: one sentence on where extinctions or opacities come from.
        strength_range: smallest and largest of them; NaN for an empty set.
    """

    source: str
    path: str
    num_points: int
    radius: str
    radius_range: tuple[float, float]
    color: str
    strength: str
    strength_range: tuple[float, float]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        lines = [
            f"{self.path or 'points'}: {self.num_points} points ({self.source})",
            f"radius    {self.radius_range[0]:.6g} .. {self.radius_range[1]:.6g}: {self.radius}",
            f"colour    {self.color}",
            f"strength  {self.strength_range[0]:.6g} .. {self.strength_range[1]:.6g}: {self.strength}",
        ]
        return "\n".join([*lines, *(f"note      {note}" for note in self.notes)])


def points_from_table(
    table: ParticleTable,
    *,
    color: Any = None,
    radius: Any = None,
    extinction: Any = None,
    opacity: Any = None,
    profile: Any = "gaussian",
    colormap: str = "viridis",
) -> tuple[Points, PointsReport]:
    """The points of a table, and the report on what was settled.

    Args:
        table: what was read.
        color: as for `jaxsph.io.read_points`; the name of a column of three or four numbers is that of colours, and of one
            number a point of what is shown by the colour map over its range.
        radius, extinction, opacity: a number, one a point, or the name of a quantity (`jaxsph.io.settle.quantities`); `None`
            for the table's own, else an opacity of 0.8. At most one of the last two is given.
        profile: as for `Points.from_arrays`. Of a function of the offset, the scalar columns are the attributes.
        colormap: name of a colour map.

    Raises:
        ValueError: no radius is given and none is there; an unknown column; numbers that are not finite, or out of range.
    """
    with naming(table.path):
        asked = {"radius": radius, "color": color, "extinction": extinction, "opacity": opacity}
        strength = {name: checks.plain(name, value, OF_FILE) for name, value in asked.items()}
        radii, radius_origin = _radii(table, strength.pop("radius"))
        colors, color_origin = _colors(table, strength.pop("color"), colormap)
        kind, strengths, strength_origin, noted = _strengths(table, strength)
        notes = [one for one in table.conventions if not one.startswith("support =") and "pass `support=`" not in one]
        rounding = rounding_note(table.position, radii, "radii")
        notes += [*noted, *([rounding] if rounding else [])]
        own = [name for name in table.scalars if name not in ("position", "radius", "color", "extinction", "opacity")]
        attributes = {name: _finite(name, table.columns[name]) for name in own} if callable(profile) else {}
        shown: dict[str, Any] = {kind: strengths}
        points = Points.from_arrays(table.position, radii, colors, profile=profile, attributes=attributes, **shown)
        report = PointsReport(
            source=table.source,
            path=table.path,
            num_points=len(table),
            radius=radius_origin,
            radius_range=range_of(radii),
            color=color_origin,
            strength=strength_origin,
            strength_range=range_of(strengths),
            notes=tuple(notes),
        )
        return points, report


def glow(table: ParticleTable, called: str, look: str | None, around: Float[np.ndarray, "particles 3"]) -> tuple[Points, str]:
    """Particles of a type beside those of another, and what was chosen for them.

    Many glow by their column of mass, to an optical depth of 2 in the brightest per cent of it, haloes to a third of that; radii
    reach 32 neighbours, or 5 % of the extent. Few, as sinks are, are marks of a colour, of their own radius, but at least 1.5 %
    of the extent. That is of `around`, (N, 3), what they lie in.

    Args:
        table: the particles.
        called: by which name they were asked for.
        look: a colour, or a colour map, which then is by the logarithm of each one's own density; None for that of their kind.
        around: positions, length units.
    """
    ends = np.percentile(around if len(around) else table.position, (5, 95), axis=0) if len(table) else np.zeros((2, 3))
    extent = float(np.ptp(ends, 0).max()) or 1.0
    if len(table) <= MARKERS:
        stored = table.named(*RADIUS_NAMES, *SMOOTHING_NAMES)
        own = np.zeros(len(table)) if stored is None else table.exact(stored)
        radius = np.maximum(np.where(own > 0, own, 0), MARK * extent)
        return Points.from_arrays(table.position, radius, rgb(look or "white"), opacity=OPAQUE, profile="ball"), "as marks"
    radius = np.minimum(nearest_neighbour_supports(table.position, box=table.box_size), WIDEST * extent)
    mass = table.masses()
    mass = np.ones(len(table)) if mass is None else mass
    middle = ends.mean(0)[:2, None]
    x, y = table.position.T[:2].astype(np.float64)
    near: Any = middle + [-extent / 2, extent / 2]
    columns = np.histogram2d(x, y, CELLS, near, weights=mass)[0]
    some = columns[columns > 0] if columns.any() else mass
    bright = float(np.percentile(some, BRIGHT)) / (extent / CELLS) ** 2 * (3 if called in HALOES else 1)
    color: Any = look or GLOWS.get(called, "white")
    if look is None or look.startswith("#") or "," in look or look in COLORS:
        color, told = rgb(color), color
    else:
        dense, rows = np.log10(mass / radius**3), colors_of_map(look)
        places = np.linspace(*value_range(dense), len(rows))
        color, told = colors_at(dense, places, rows), f"{look} by density"
    return Points.from_arrays(table.position, radius, color, GLOW / (FOURIER * bright) * mass / radius**3), f"a glow, {told}"


def _radii(table: ParticleTable, given: Any) -> tuple[np.ndarray, str]:
    if given is not None and not isinstance(given, str):
        return positive("radius", one_each("radius", given, len(table)), REMEDY), GIVEN
    if given is None:
        names = [name for name in RADIUS_NAMES if name != "r" or not _named_all(table, COLOR_TRIPLES[0])]
        given = next((name for name in (table.named(one) for one in names) if name and table.columns[name].ndim == 1), None)
    if table.support is not None and (given is None or called(SUPPORT_NAMES, [given])):
        return table.support.astype(np.float64), table.said("support =", "the support of the file")
    if given is None:
        given = table.named(*SMOOTHING_NAMES)
    if given is None:
        remedy = "give `radius=NUMBER` (:radius=R), or the name of a column"
        raise DataError(f"has no radius of its points: {_there_is(table)}; {remedy}")
    values, name = _values(table, "radius", given)
    return positive(name, values, REMEDY), f"column `{name}`"


def _colors(table: ParticleTable, given: Any, colormap: str) -> tuple[Any, str]:
    if given is not None and not isinstance(given, str):
        return given, GIVEN
    if isinstance(given, str):
        named = [given if given in table.columns else table.named(given)]
    else:
        for triple in COLOR_TRIPLES:
            if names := _named_all(table, triple):
                columns = np.stack([table.columns[name] for name in names], 1)
                return _unit(", ".join(names), columns), f"columns {', '.join(f'`{name}`' for name in names)}"
        named = [table.named(name) for name in COLOR_NAMES]
    for name in named:
        if name is not None and table.columns[name].ndim == 2 and table.columns[name].shape[1] in (3, 4):
            return _unit(name, table.columns[name][:, :3]), f"column `{name}`"
    if given is None:
        return (1.0, 1.0, 1.0), "white, as there are no colours"
    values, name = _values(table, "color", given)
    (low, high), rows = value_range(values), colors_of_map(colormap)  # over nearly all of its range
    places = np.linspace(low, high, len(rows))
    colors = colors_at(values, places, rows)
    return colors, f"{colormap} over {name} = {low:.6g} to {high:.6g}"


def _strengths(table: ParticleTable, given: dict[str, Any]) -> tuple[str, np.ndarray, str, list[str]]:
    """Whether extinction or opacity, which, where it comes from, and what else is to be said."""
    asked = {name: value for name, value in given.items() if value is not None}
    if len(asked) > 1:
        raise DataError("`extinction` and `opacity` are two names for one thing; give one of them")
    if not asked:
        stored = table.named(*EXTINCTION_NAMES)
        asked = {"opacity": table.named(*OPACITY_NAMES)} if stored is None else {"extinction": stored}
    ((kind, value),) = asked.items()
    if value is None:
        note = f"{OPACITY} through the centre of each; `opacity=` or `extinction=` sets it"
        note = f"neither extinction nor opacity is there: {note}"
        return kind, np.full(len(table), OPACITY), f"opacity {OPACITY}", [note]
    if not isinstance(value, str):
        return kind, one_each(kind, value, len(table)), f"{kind} {GIVEN}", []
    values, name = _values(table, kind, value)
    if kind == "extinction":
        return kind, values, f"extinction, column `{name}`", []
    values = _unit(name, table.columns.get(name, values))
    notes = [f"opacities above {OPAQUE} are taken for {OPAQUE}"] if (values > OPAQUE).any() else []
    return kind, np.minimum(values, OPAQUE), f"opacity, column `{name}`", notes


def _values(table: ParticleTable, role: str, name: str) -> tuple[np.ndarray, str]:
    """A quantity by its name, all of it finite."""
    column = name if name in table.columns else table.named(name)
    if column is not None and table.columns[column].ndim == 1:
        return _finite(column, table.columns[column]), column
    try:
        return choose_quantity(table, name)
    except DataError as error:
        said = str(error)
        if "there is no quantity" in said:
            said = f"there is no column {name!r}: {_there_is(table)}; choose one of them{did_you_mean(name, table.columns)}"
        raise DataError(f"`{role}`: {said}") from error


def _finite(name: str, values: np.ndarray) -> np.ndarray:
    values = values.astype(np.float64)
    refuse_rows(~np.isfinite(values), values, f"column `{name}` must be finite", "repair or remove these points")
    return values


def _unit(name: str, column: np.ndarray) -> np.ndarray:
    """Numbers in [0, 1]; whole ones up to 255 are bytes."""
    values = _finite(name, column)
    are_bytes = column.dtype == np.uint8 or (1 < values.max(initial=0) <= BYTE and (values == np.round(values)).all())
    wrong = np.asarray((values < 0) | (values > (BYTE if are_bytes else 1)))
    must = f"column `{name}` must be in [0, 1], or whole numbers from 0 to {BYTE}"
    refuse_rows(wrong, values, must, "scale it, or leave it out")
    return values / BYTE if are_bytes else values


def _named_all(table: ParticleTable, names: tuple[str, ...]) -> list[str]:
    """The scalar columns of these names where all of them are there."""
    found = [table.named(name) for name in names]
    return [name for name in found if name is not None and table.columns[name].ndim == 1] if None not in found else []


def _there_is(table: ParticleTable) -> str:
    return f"there are {', '.join(table.columns)}" if table.columns else "there are positions alone"
