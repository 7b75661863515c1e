"""The commands `project`, column densities, means along rays and emission of a particle file; and `slice`, a quantity on a plane.

Flow: file or scene, options -> [planes] -> project, slice -> EXR, NPY, FITS or PNG.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from jaxsph import io
from jaxsph.analysis.at_places import Slice as Sliced
from jaxsph.analysis.at_places import carrying
from jaxsph.analysis.at_places import slice as slice_of
from jaxsph.analysis.projection.plan import PIXELS, particles_in
from jaxsph.analysis.projection.project import ALONG, WEIGHED, projected
from jaxsph.cli import console, figures, groups
from jaxsph.cli import scene as cli_scene
from jaxsph.cli.console import SCENE, UsageError, units_of, wrong_usage
from jaxsph.cli.groups import OUTPUT, OWN, offered, output
from jaxsph.cli.voice import say, say_all
from jaxsph.engine.runtime.executors import Eager
from jaxsph.io import Labels
from jaxsph.io.images.planes import SUFFIXES, converted
from jaxsph.io.opening import values
from jaxsph.io.opening.looks import is_light, kind_of, values_of
from jaxsph.io.opening.opened import Loaded, Opened, in_sight, is_free
from jaxsph.io.opening.options import CAMERA, COLORED, DATA, LOOK, Look, Source, View, choice, option
from jaxsph.io.opening.part_types import read_together
from jaxsph.io.opening.views import (
    TURNED,
    Framed,
    amid,
    clip_of,
    direction_of,
    ends_of,
    flat_on,
    framed,
    in_period,
    left_by,
    masses_of,
    places_of,
    sighted,
)
from jaxsph.io.settle.around import shortest
from jaxsph.io.settle.assemble import SUPPORTS, WHOLE, Settled, chosen
from jaxsph.io.settle.quantities import (
    LOG_PREFIX,
    choose_quantity,
    formulas_said,
    is_log,
    unit_of,
    velocity_name,
    without_logarithm,
)
from jaxsph.io.settle.supports import density_as_summed
from jaxsph.io.table import PURE, ROLES, CodeUnit, has_role, plain
from jaxsph.io.units import CODE_UNITS, can_name, moment_of, named, spoken, written
from jaxsph.model import Camera, Particles, Scene, TransferFunction
from jaxsph.model.camera.framing import UP, VIEWS, with_depths
from jaxsph.model.clips import Plane
from jaxsph.model.particles.columns import emission_measure
from jaxsph.model.preview.frame import bulk_of, central, num_outside
from jaxsph.model.projection import CUT_TOLD, NORMS, Projection
from jaxsph.model.transfer.looks import PRESETS
from jaxsph.numerics.checks import array_of, require_positive

MASS, VOLUME, NUMBER = "mass", "volume", "number"
SUMMED = {
    MASS: "column density: mass a unit of area",
    VOLUME: "length inside particles: volume a unit of area",
    NUMBER: "particles a unit of area",
}
"""What particles hold themselves; anything else is held by their volume."""
LOOKS = "colormap", "norm", "range"
WRITTEN = (*SUFFIXES, *figures.VECTORS)
BETWEEN = "what lies between: coordinates along the --view, or depths from the --eye"
FIELDS = "mean", "sum"
ON_LIGHT = "heat_r"  # colours of what has no sign on a light background, from light to dark as those of other commands
ARROWS = 20  # across a picture
MOST_OF_PICTURE = 0.75  # of the height of a picture of all: what fills more is shown with all
BESIDE = 1e-2  # of a support, by which particles of a plane may lie beside it, as kernels are flat there


def _flat(options: Any) -> Any:
    """Options with a line of sight, checked before a file is read: against the normal of a plane, or that of all
    particles; and with the colours that a type was asked for with.
    """
    looks = [look for _, look in options.types if look is not None]
    if looks and len(options.types) > 1:
        why = "has looks of types, and here all types are one sum: leave them out, --colormap NAME is for the sum"
        raise UsageError(f"--part-type {options.part_type} {why}")
    if looks and options.colormap is None:
        with wrong_usage():
            options = dataclasses.replace(options, colormap=values.colormap(looks[0]))
    if getattr(options, "plane", None) is not None:
        return dataclasses.replace(options, view=options.plane.normal, eye=None, target=None, fov_degrees=None)
    with wrong_usage():
        dataclasses.replace(options, view=None if options.eye is not None else options.view or "z")
    return options


def _opened(options: Any, loaded: Loaded, like: Opened | None, transfer: TransferFunction | None = None) -> Opened:
    """How particles are seen, of a periodic set around what is in the middle: as another, or all where no more is asked; said."""
    shown: Any = loaded.shown
    table = loaded.table
    if table is not None and len(table) != shown.num_particles:
        table = chosen(table, "x", *options.how, **options.which)
    ends: Any = ()
    scene, plane = Scene(particles=shown, transfer=transfer), getattr(options, "plane", None)
    if scene.particle_set.box is not None:
        center, is_part = options.center if like is None else like.center, options.width is not None or options.view in TURNED
        if center is None and is_part and options.eye is None and not options.clips:
            center = amid(scene)
        options = dataclasses.replace(options, center=center if center is None or isinstance(center, str) else tuple(center))
        ends = [plane.point] * 2 if plane else _slab(options)
        with wrong_usage():
            particles, options = in_period(scene, options, table, *ends)
        scene = dataclasses.replace(scene, particles=particles)
    left_by(clip_of(options), scene)
    with wrong_usage():
        seen: Any = like or framed(scene, options, table, whole=True)
    if like is None and is_free(options):
        seen, scene = _framed_by_mass(seen, scene, options, table)
        if scene.particle_set.box is not None:
            scene = dataclasses.replace(scene, particles=in_period(scene, options, table, *ends)[0])
    say_all(seen.said)
    labels = None if transfer is None else cli_scene.key_of(loaded, options)
    return Opened(scene, seen.camera, labels or Labels(), (), seen.center, seen.up)


def _framed_by_mass(whole: Framed, scene: Scene, options: Any, table: io.ParticleTable | None) -> tuple[Framed, Scene]:
    """How particles are seen of which the central 99 % of the mass are in a small part of the picture of all; said."""
    particles = scene.particle_set
    mass = np.zeros(particles.capacity)
    mass[: particles.num_particles] = 1.0 if table is None else masses_of(table)
    if not (mass > 0).any() or not np.isfinite(mass).all():
        return whole, scene
    if particles.box is not None:
        particles = particles.centered(np.mean(bulk_of(particles, mass).bounds(), 0))
    direction = direction_of(options, whole.up, table)
    camera = central(particles, mass, direction)
    if float(camera.half_height) > MOST_OF_PICTURE * float(whole.camera.half_height):
        return whole, scene
    scene = dataclasses.replace(scene, particles=particles)
    outside = num_outside(scene, dataclasses.replace(camera, near=array_of(-np.inf), far=array_of(np.inf)))
    told = f"{outside:,} of {particles.num_particles:,} particles lie outside of the picture; --width all shows them"
    forward = direction.axes[2]
    middle = np.mean(bulk_of(particles, mass).bounds(), 0)
    if whole.center is not None:
        middle = middle + (whole.center - middle) @ forward * forward
    if particles.box is not None:
        lower, upper = particles.box.corners()
        middle = lower + (middle - lower) % (upper - lower)
    return whole._replace(camera=camera, said=[*whole.said, *[("frame", told)] * (outside > 0)], center=middle), scene


def _slab(options: Any) -> Any:
    """From where to where, (2, 3), a depth range along an axis is."""
    ends = np.array([[-np.inf] * 3, [np.inf] * 3])
    if getattr(options, "depth_range", None) is not None and options.view in VIEWS:
        ends[:, "xyz".index(options.view)] = np.sort(options.depth_range)
    return ends


@offered(
    without="color_by opacity_by preset transfer exposure optical_depth surface surface_of smoothing light occlusion antialias"
)
class Project(groups.Options, groups.Key, Look, View, Source):
    """Options of the command."""

    suffix, numbers = ".exr", (".exr", ".npy", ".fits")

    along_z: Any = True
    output: Path | None = output(f"{', '.join(WRITTEN)} (default: FILE's name with .exr, here)")
    of: str | None = option(None, "NAME", str, OWN, "mass, number, volume, a quantity or an expression (default: mass or number)")
    weight: str | None = option(None, "NAME", str, OWN, "mean of --of along rays, by mass, number, volume or a quantity x volume")
    along: str | None = choice(None, ALONG, OWN, "what is made of --of along rays", " (default: mean with --weight, else sum)")
    emission: float | None = option(None, "N", values.number, OWN, "the integral of density^N, times --of where that is given")
    pixel: str = option(PIXELS[0], "mean|ray", values.one_of(PIXELS), OWN, "means of pixels, which keep mass, or values of rays")
    tolerance: float = option(0.0, "SHARE", values.number, OWN, "of a particle's peak: what interpolating wide ones may cost")
    arrows: str | None = option(None, "NAME", str, OUTPUT, "with --annotate: arrows of a vector as velocity, its mean along rays")
    depth_range: Any = option(None, "A,B", values.measured(values.span), CAMERA, BETWEEN)
    norm: str | None = choice(None, NORMS, LOOK, "of a .png", " (default: log over a decade)")


def project(*files: Annotated[str, Parameter(help="files of particles")], asked: Project = Project()) -> None:
    """Project, write, and say.

    NAME is mass, volume, number (of particles), or any quantity of the file, as velocity.los, or an expression of them. Without
    --weight, mass is projected to a column density, number to a column number density, and the integral of any other quantity is
    taken along rays; --along max shows the largest value of the particles whose supports a ray meets.
    """
    for file in files:
        if file.startswith(SCENE):
            raise UsageError(f"{file}: a projection is of a file of particles; `jaxsph render` shows built-in scenes")
    options = figures.of_files(asked, files)
    output = figures.output_of(options, "a projection must be", WRITTEN, options.suffix)
    figures.draw(_flat(options), output, _projected)


def _projected(options: Any, like: Opened | None) -> tuple[Opened, Callable[[], figures.Made]]:
    """How a file is seen, and what makes its projection."""
    table = _table_of(options)
    say("file", f"{options.source}: {table.source}, {len(table):,} particles")
    options, told = flat_on(options, table.position, table.box_size, table.up)
    say_all(told)
    with wrong_usage(of=io.ConditionError):
        needed = _needs_volumes(options, table)
        which = options.which | {"volumes": needed}
        names = options.of, options.weight, options.contours
        table = chosen(in_sight(table, options, options, *names), "density" if needed else "x", *options.how, **which)
    particles, report = io.particles_from_table(table, "x", *options.how, effort=WHOLE if needed else SUPPORTS)
    console.say_report(report, particles.to_numpy()["support"])
    opened = _opened(options, Loaded(options.source, particles, options.of or MASS, table=table), like)
    particles = opened.scene.particle_set
    camera = _through(opened.camera, options, particles)
    columns = _Columns(sighted(table, camera, camera.is_perspective, particles), particles)
    options = dataclasses.replace(options, of=columns.called(options.of), weight=columns.called(options.weight))
    with wrong_usage(of=io.ConditionError):
        of, weight, name, what = _asked(columns, options)
    say("values", what)
    left = Scene(particles=particles, within=clip_of(options))
    inside = np.asarray(particles_in(left)[1].valid)[: len(of)]
    if left.within is not None:
        say("clip", f"columns of the {int(inside.sum()):,} particles whose centres are inside, with all of their supports")
    code, length = columns.unit(options), table.units.length
    factor, unit = _factor_of(code, options)
    of_total = code and length and code.over(length, -2)

    def make() -> figures.Made:
        clock, started = Eager(), time.perf_counter()
        asked = of, weight, name, written(code)
        how: dict[str, Any] = {"pixel": options.pixel, "tolerance": options.tolerance, "along": options.along}
        image = projected(clock, left, camera, asked, **how)
        said, results = _told_of(image, of[inside] if name.startswith(("column", "emission")) else None, of_total)
        if unit:
            numbers: Any = converted(image.values, factor)
            image = dataclasses.replace(image, values=numbers, unit=unit)
        if options.background is not None and image.weight is None:  # it is seen where there is nothing along a ray, as of means
            image = dataclasses.replace(image, weight=image.values)
        took = {stage: clock.seconds[stage] for stage in ("compile", "cast")}
        stats = {"seconds": {"plan": time.perf_counter() - started - sum(took.values()), **took}}
        there = np.asarray(image.values)[np.isfinite(image.values)]
        light = {"colormap": ON_LIGHT} if is_light(options.background) and (there >= 0).all() else {}
        look = light | {each: value for each in LOOKS if (value := getattr(options, each)) is not None}
        largest = float(np.abs(there).max(initial=0))
        shown = (1.0, unit or CODE_UNITS) if unit or code is None or not can_name() else named(code, largest, None, length)
        more = {"length_unit": options.length_unit, "weight": options.weight or ""}
        labels = Labels(name, shown[1], shown[0], length, moment=moment_of(table.units), **more)
        ends, in_words = figures.ends_said(there, labels, unit or spoken(code), options)
        results |= {"name": name} | ends
        about = "image", f"{options.size[0]} x {options.size[1]}, {name} {in_words}"
        arrows = () if options.arrows is None else (columns.arrows(options.arrows, left, camera),)
        contours = None if options.contours is None else columns.contours(options, left, camera)
        return figures.Made(image, about, said, results, stats, look, labels, arrows, contours)

    return dataclasses.replace(opened, camera=camera, measures=(options.unit or written(code), written(length), name)), make


def _needs_volumes(options: Any, table: io.ParticleTable) -> bool:
    """Whether a projection is of more than masses or numbers, which need neither volumes nor densities."""
    of, masses = plain(options.of or MASS), map(plain, (NUMBER, *ROLES["mass"], table.of_role("mass") or MASS))
    others = options.weight, options.emission, options.arrows, options.contours
    return of not in masses or options.along not in (None, "sum") or any(other is not None for other in others)


def contours_over(options: Any, opened: Opened) -> tuple[np.ndarray, str, CodeUnit | None]:
    """Over a picture of a file of particles, and of all that is along its rays: those of `project`, see `_Columns.contours`."""
    if opened.scene.particles is None or options.source.startswith(SCENE):
        raise UsageError("--contours is for a file of particles, which has columns: leave it out")
    table, particles = in_sight(_table_of(options), options, options, options.contours), opened.scene.particle_set
    table = chosen(table, "density", *options.how, **options.which)
    if len(options.types) > 1:  # of which the picture has others beside the first
        box, particles = particles.box, io.particles_from_table(table, "x", *options.how)[0]
        particles = particles if box is None else particles.centered(np.mean(box.corners(), 0))
    table = table.rows(np.asarray(particles.valid)[: len(table)])  # without those that lie far from all others
    camera = with_depths(dataclasses.replace(opened.camera, near=None, far=None), particles)  # type: ignore[arg-type]
    columns = _Columns(sighted(table, camera, camera.is_perspective, particles), particles)
    return columns.contours(options, dataclasses.replace(opened.scene, particles=particles), camera)


def _table_of(options: Any) -> io.ParticleTable:
    """The particles of all types that are asked for."""
    return read_together(options.source, options.types, options.physical, *options.how, options.box)


def _through(camera: Camera, options: Any, particles: Particles) -> Camera:
    """A camera of columns: through all there is, or between the depths that are asked for."""
    camera = dataclasses.replace(camera, near=None, far=None)  # type: ignore[arg-type]
    if options.depth_range is None:
        return with_depths(camera, particles)
    ends, forward = np.asarray(options.depth_range), camera.exact_axes()[2]
    if not camera.is_perspective:  # coordinates along an axis, or towards where the picture is seen from
        axis = np.abs(forward) if options.view in VIEWS else -forward
        ends = np.sort((ends - camera.exact_eye() @ axis) * (axis @ forward))
    elif not ends[0] > 0:
        raise UsageError(f"--depth-range must be > 0, as depths from the eye are, got {ends[0]:g}")
    near, far = (array_of(end, camera.dtype) for end in ends)
    return dataclasses.replace(camera, near=near, far=far)


def _told_of(image: Projection, of: np.ndarray | None, unit: CodeUnit | None) -> tuple[dict[str, str], dict[str, Any]]:
    """What is said of a projection, and its results; `of` amounts that add up in a picture, and their unit."""
    said, results = {}, {}
    if image.cut > CUT_TOLD:
        said["depths"] = f"{image.cut:.1%} of what is in the picture lies outside of these depths"
    if of is not None and not image.perspective:
        total, of_all = float(image.total()), float(np.sum(of))
        said["total"] = f"{total:.7g} in the image, of {of_all:.7g} {units_of(spoken(unit))}"
        results = {"total": total, "of_all": of_all, "total_unit": spoken(unit)}
    if (off := dict(image.metadata).get("jaxsph.tolerance")) is not None:
        said["tolerance"] = f"wide supports are interpolated, to some {off:.2g} of each one's peak"
    return said, results


def _factor_of(code: CodeUnit | None, options: Any) -> tuple[float, str]:
    """What values are to be multiplied by, and the unit that they are then in, where one is asked for."""
    if options.unit is None:
        return 1.0, ""
    if code is None:
        why = "cannot be used, as the file does not state that of what is projected; leave it out"
        raise UsageError(f"--unit {options.unit} {why}")
    with wrong_usage():
        return named(code, 1.0, options.unit)


class _Columns:
    """What a file's particles hold, in float64."""

    def __init__(self, table: io.ParticleTable, particles: Particles) -> None:
        support = particles.to_numpy()["support"].astype(np.float64)
        self._settled = Settled(dataclasses.replace(table, support=support, kernel=particles.kernel), None, None)
        self.table, self.mass_name = self._settled.table, self._settled.mass_name
        self.thickness = self._settled.thickness
        self.weighing = NUMBER if self.mass_name is None else MASS  # by which means are, where nobody says so

    def called(self, name: Any) -> Any:
        """A name, if any, that of a column of masses as `mass`: these are summed as they are, however the file calls them."""
        return MASS if self.mass_name is not None and has_role(name or "", "mass") else name

    def values(self, name: str) -> np.ndarray:
        """A number a particle."""
        if name == NUMBER:
            return np.ones(len(self.table))
        if name == MASS and self.mass_name is None:
            raise UsageError("the file has no masses; project --of number, volume or a quantity")
        if name == VOLUME:
            return self.volume
        notes = without_logarithm(self.table, self._settled.density, ..., name)
        console.say_notes([*notes, *formulas_said(self.table, name)])
        return choose_quantity(self.table, name, density=self._settled.density)[0]

    def amounts(self, name: str) -> np.ndarray:
        """What is summed up of a name: masses and volumes as they are, of all that each stands for, others times volume."""
        each = self.table.stands_for if name in (MASS, NUMBER) else 1.0 if name == VOLUME else self.volume
        return self.values(name) * each

    @functools.cached_property
    def density(self) -> np.ndarray:
        """As stored where that is the density, else summed over each particle's support."""
        stored = self._settled.stored
        if stored.column is not None:
            return density_as_summed(self.table, stored.column)
        return self._settled.density() if stored.told else self.values("density")

    @functools.cached_property
    def volume(self) -> np.ndarray:
        """Those of the particles."""
        return self._settled.volumes()[0]

    def unit(self, options: Any) -> CodeUnit | None:
        """The unit of what is asked for, as far as the file states those that it is made of."""
        of_values = options.along in (*WEIGHED, "max") or (options.weight is not None and options.along is None)
        name = options.of or ("density" if of_values else self.weighing)
        own, length = unit_of(self.table, (self.mass_name or MASS) if name == MASS else name), self.table.units.length
        if not of_values:
            own = PURE if name in (NUMBER, VOLUME) else own
            own = own and length and own.over(length, 2 if name in (MASS, NUMBER) else 2 - self.table.dimensions)
        return None if options.emission is not None or is_log(name) else own

    def contours(self, options: Any, shown: Scene, camera: Camera) -> tuple[np.ndarray, str, CodeUnit | None]:
        """Of what adds up along rays, or else of a mean along them: values, what they are called, and their unit."""
        name = self.called(options.contours)
        asked = Project(of=name, weight=None if name in SUMMED else getattr(options, "weight", None) or self.weighing)
        of, by, called, _ = _asked(self, asked)
        image = projected(Eager(), shown, camera, (of, by, called, ""), pixel=getattr(options, "pixel", asked.pixel))
        return np.asarray(image.values), called, self.unit(asked)

    def arrows(self, wanted: str, shown: Scene, camera: Camera) -> tuple[np.ndarray, np.ndarray, str, str, float]:
        """Components of a vector to the right and upwards, means along rays by mass, else volume; its name, unit and factor."""
        role = velocity_name(self.table) if has_role(wanted, "velocity") else None
        name = self.table.named(wanted) or role
        vectors = [one for one in self.table.vectors if self.table.columns[one].shape[1] == 3]
        if name not in vectors:
            raise UsageError(f"--arrows {wanted}: there is no such vector; there are {', '.join(vectors) or 'none'}")
        weight = self.amounts(VOLUME if self.mass_name is None else MASS)
        coarse = dataclasses.replace(camera, width=ARROWS, height=max(1, round(ARROWS * camera.height / camera.width)))
        parts = self.table.exact(name) @ camera.exact_axes()[:2].T
        labels = io.labels_of(self.table, name, float(np.abs(parts).max(initial=0)))
        right, up = (np.asarray(projected(Eager(), shown, coarse, (part, weight, None, "")).values) for part in parts.T)
        return right, up, name, labels.unit, labels.factor


def _asked(columns: _Columns, options: Any) -> tuple[np.ndarray, np.ndarray | None, str, str]:
    """Amounts or values, weights, the name of the result, and a sentence about it."""
    of, along = options.of, options.along or ("sum" if options.weight is None else "mean")
    if options.weight is not None and along not in WEIGHED:
        raise UsageError(f"--weight is for a mean or a dispersion along rays: leave it out of --along {along}")
    if options.emission is not None and options.along not in (None, "sum"):
        raise UsageError(f"--emission is a sum along rays: leave out --along {along}")
    if options.emission is not None:
        factor, times, name = (1.0, "", "emission") if of is None else (columns.values(of), f"{of} x ", f"emission.{of}")
        said = f"integral of {times}density^{options.emission:g} along rays, each particle with its own density"
        return emission_measure(columns.amounts(MASS), columns.density, factor, options.emission), None, name, said
    if along in WEIGHED:
        of, weight = of or "density", options.weight or columns.weighing
        said = f"{along} of {of} along rays, weighted by {weight}"
        return columns.values(of), columns.amounts(weight), f"{along}.{of}", said
    if along == "max":
        of = of or "density"
        return columns.values(of), None, f"max.{of}", f"the largest {of} of the particles whose supports a ray meets"
    of = of or columns.weighing
    return columns.amounts(of), None, f"column.{of}", SUMMED.get(of, f"integral of {of} along rays: {of} times length")


@offered(without="opacity_by exposure optical_depth surface surface_of smoothing light occlusion antialias")
class Slice(groups.Options, groups.Key, Look, View, Source):
    """Options of the command."""

    numbers = ".npy", ".fits"

    along_z: Any = True
    color_by: str | None = option(None, "NAME", str, DATA, COLORED, "--of", "--color-by", "--quantity")
    weight: str | None = option(None, "NAME", str, OWN, "of a mean: mass, number, or a quantity times volume (default: volume)")
    plane: Any = option(
        None, "X,Y,Z,NX,NY,NZ", values.measured(values.plane), OWN, "through X,Y,Z, seen from along NX,NY,NZ (default: middle)"
    )
    field: str | None = choice(
        None, FIELDS, OWN, "the normalised mean of the quantity, or what is summed over kernels", " (default: sum of a density)"
    )
    output: Path | None = output(f"{', '.join(WRITTEN)} (default: FILE's name with .png, here)")


def slice(*files: Annotated[str, Parameter(help="files of particles, or scene:NAME")], asked: Slice = Slice()) -> None:
    """Show the quantity on a plane, write, and say."""
    options = figures.of_files(asked, files)
    output = figures.output_of(options, "an image must be", WRITTEN, options.suffix)
    figures.draw(_flat(options), output, _sliced)


def _sliced(options: Any, like: Opened | None) -> tuple[Opened, Callable[[], figures.Made]]:
    """How a plane of a file is seen, and what makes what is on it."""
    if like is not None and not options.source.startswith(SCENE):
        options = dataclasses.replace(options, color_by=like.labels.quantity)
    loaded, own, _ = cli_scene.loaded_of(options, joined=True)
    if not isinstance(loaded.shown, Particles):
        raise UsageError(f"{options.source}: a slice is of particles, and this is a volume")
    options, told = flat_on(options, *places_of(loaded.shown), UP if loaded.table is None else loaded.table.up)
    say_all(told)
    is_own = own is not None and not cli_scene.is_looked(options)
    kind, looks = PRESETS[options.preset or kind_of(loaded.quantity, values_of(loaded.shown))], options
    if kind.lift and kind.domain == "log" and options.colormap is None and options.transfer is None:  # as nothing is clear there
        looks = dataclasses.replace(options, colormap=kind.colormap + "_r" * is_light(options.background))
    transfer: Any = own.looks[0] if is_own else cli_scene.look(loaded.shown, looks, loaded.quantity)  # type: ignore[union-attr]
    table = loaded.table
    if table is not None and (options.view in TURNED or options.center == "mass"):
        table = chosen(table, "x", *options.how, **options.which, volumes=False)
    opened, clip = _opened(options, dataclasses.replace(loaded, table=table), like, transfer), clip_of(options)
    seen, loaded = opened.camera, dataclasses.replace(loaded, shown=opened.scene.particle_set)
    _, up, forward = seen.exact_axes()
    center = np.mean(left_by(clip, loaded.shown).bounds(), 0) if opened.center is None else opened.center
    away = float((center - seen.exact_eye()) @ forward) if seen.is_perspective else 1.0
    plane = options.plane or Plane(tuple(center), tuple(-forward))
    frame: dict[str, Any] = {"within": clip, "center": center, "up": up, "view_height": 2 * float(seen.half_height) * away}
    frame |= {"width": options.size[0], "height": options.size[1]}
    table, quantity, labels = loaded.table, loaded.quantity, opened.labels
    code = None if table is None or is_log(quantity) else unit_of(table, quantity)
    factor = 1.0 if options.unit is None else labels.factor

    def in_unit(values: Any) -> Any:
        """Values in the unit that is asked for."""
        return values + math.log10(factor) if is_log(quantity) else converted(values, factor)

    def make() -> figures.Made:
        made = _on_plane(options, loaded, plane, frame)
        there = np.isfinite(made.values)
        if not there.any() and (shown := opened.scene.particle_set).num_particles:
            near = np.abs((shown.exact_position() - plane.point) @ forward) < np.where(shown.valid, shown.support, 0)
            why = "no pixel is inside of a support: give a larger --size" if near.any() else "no particle reaches the plane"
            raise ValueError(
                f"{why}; there are particles {ends_of(*dataclasses.replace(shown, box=None).bounds())}, see --plane and --center"
            )
        told = () if code is None else (("jaxsph.unit", written(code) if options.unit is None else labels.unit),)
        made = dataclasses.replace(made, values=in_unit(made.values), metadata=(*made.metadata, *told))
        found, inside = made.values[there], float(there.mean())
        key = dataclasses.replace(labels, factor=labels.factor / factor)
        stated = None if table is None else unit_of(table, quantity)
        ends, in_words = figures.ends_said(found, key, spoken(stated) if options.unit is None else labels.unit, options)
        said = {"slice": f"{in_words}, {inside:.1%} of the pixels inside of supports"}
        about = "image", f"{options.size[0]} x {options.size[1]}, {float(made.pixel_size):.6g} a pixel"
        results = {"inside": inside, "pixel_size": float(made.pixel_size)} | ends
        look = {"transfer": dataclasses.replace(transfer, values=in_unit(transfer.values))}
        contours: Any = None
        if (name := options.contours) is not None:
            unit = None if is_log(name) or table is None else unit_of(table, name)
            contours = _on_plane(options, loaded, plane, frame, name).values, name, unit
        return figures.Made(made, about, said, results, look=look, labels=key, contours=contours)

    measures = options.unit or written(code), "" if table is None else written(table.units.length)
    return dataclasses.replace(opened, scene=Scene(), center=center, measures=measures), make


def _on_plane(options: Any, loaded: Loaded, plane: Plane, frame: dict[str, Any], name: str | None = None) -> Sliced:
    """The quantity that is loaded, or one of another name, on a plane: NaN where there is none."""
    particles: Any = loaded.shown
    of = None
    if name is not None:
        of = _Columns(chosen(loaded.table, name, *options.how, **options.which), particles).values(name)  # type: ignore[arg-type]
        loaded = dataclasses.replace(loaded, quantity=name)
    weights, summed = _summed(loaded, options, plane)
    weighted = particles if weights is None else carrying(particles, weights, False)[0]  # by which a mean is weighted
    made = slice_of(weighted, plane, **frame, of=of if summed is None else summed, normalised=summed is None)
    if summed is None:
        return made
    shown = np.where(made.values != 0, made.values, np.nan)  # outside of every support there is nothing to show
    return dataclasses.replace(made, values=np.log10(shown) if is_log(loaded.quantity) else shown)


def _summed(loaded: Loaded, options: Any, plane: Plane) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Weights, if others than volumes; and what is summed, masses or the quantity times volumes, None of a mean. Said."""
    if loaded.table is None:
        if options.field == "sum" or options.weight is not None or options.contours is not None:
            raise UsageError("--field sum, --weight and --contours are for a file of particles, which has masses and volumes")
        return None, None
    name = loaded.quantity[len(LOG_PREFIX) :] if is_log(loaded.quantity) else loaded.quantity
    unit, is_density = unit_of(loaded.table, name), has_role(name, "density")
    is_sum = is_density or (unit is not None and unit.powers == (-3, 1, 0, 0))
    is_mean = options.weight is not None or (options.field or FIELDS[is_sum]) == "mean"
    if is_mean and options.weight is None and len(options.types) == 1:
        say("field", f"the normalised mean of {loaded.quantity}" + ", whose sum --field sum has" * is_sum)
        return None, None
    columns = _Columns(chosen(loaded.table, name, *options.how, **options.which), loaded.shown)  # type: ignore[arg-type]
    if is_mean:  # of types, whose volumes overlap, by mass
        weight = options.weight or columns.weighing
        weights = columns.amounts(columns.called(weight)) * columns.thickness
        require_positive("weight", weights, "means need weights that are not negative", strict=False)
        say("field", f"the mean of {loaded.quantity}, weighted by {weight}")
        return weights, None
    what = columns.weighing if is_density else name
    say("field", f"{what if is_density else f'{name} times volume'} summed over kernels; --field mean has the normalised mean")
    _require_within(plane, loaded)
    return None, columns.amounts(what) * columns.thickness


def _require_within(plane: Plane, loaded: Loaded) -> None:
    """Refuse sums beside particles that lie in a plane or on a line."""
    position, sides = places_of(loaded.shown)  # type: ignore[arg-type]
    if loaded.table is None or (dimensions := loaded.table.dimensions) == 3:
        return
    offset = shortest(position - np.asarray(plane.point, np.float64), sides)
    off = np.abs(offset @ np.asarray(plane.normal, np.float64))
    if off.max(initial=0) > BESIDE * float(np.asarray(loaded.shown.support).min()):  # type: ignore[union-attr]
        lies = "in a plane" if dimensions == 2 else "on a line"
        why = f"all particles lie {lies}, and sums over their kernels are densities there alone"
        raise UsageError(f"{why}: leave out --plane and --view, or give --field mean")
