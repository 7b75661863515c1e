"""The commands `project`, column densities, means along rays and emission of a particle file; and `slice`, a quantity on a plane.

Flow: file or scene, options -> [planes] -> project, slice -> EXR, NPY, FITS or PNG.
"""

from __future__ import annotations

import dataclasses
import functools
import time
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
from jaxsph.cli import console, groups
from jaxsph.cli import scene as cli_scene
from jaxsph.cli.console import SCENE, Made, UsageError, produce, span, wrong_usage
from jaxsph.cli.groups import OUTPUT, OWN, offered, output
from jaxsph.cli.voice import say, say_all
from jaxsph.engine.runtime.executors import Eager
from jaxsph.io import Labels
from jaxsph.io.images.planes import SUFFIXES
from jaxsph.io.opening import values
from jaxsph.io.opening.looks import is_light, kind_of
from jaxsph.io.opening.opened import Loaded, Opened
from jaxsph.io.opening.options import CAMERA, COLORED, DATA, LOOK, Look, Source, View, choice, option
from jaxsph.io.opening.views import clip_of, ends_of, framed, left_by, place_of, sighted
from jaxsph.io.settle.assemble import Settled, chosen
from jaxsph.io.settle.quantities import LOG_PREFIX, ROLES, choose_quantity, is_log, unit_of, velocity_name
from jaxsph.io.table import CodeUnit, plain
from jaxsph.io.units import CODE_UNITS, can_name, moment_of, named, written
from jaxsph.model import Camera, Particles, Scene, TransferFunction
from jaxsph.model.camera.framing import VIEWS, upright, with_depths
from jaxsph.model.clips import Plane
from jaxsph.model.particles.columns import emission_measure
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
OF_FIGURES = "annotate title dpi font_size length_unit"
OF_PICTURES = f"{OF_FIGURES} {' '.join(LOOKS)} arrows"
"""Options of figures, and of pictures of columns, which raw values do not have."""
WRITTEN = (*SUFFIXES, *console.VECTORS)
BETWEEN = "what lies between: coordinates along the --view, or depths from the --eye"
FIELDS = "mean", "sum"
ON_LIGHT = "heat_r"  # colours of what has no sign on a light background, from light to dark as those of other commands
ARROWS = 20
"""Across a picture."""


def _flat(options: Any) -> Any:
    """Options with a line of sight along z where none is asked for; what does not suit it is refused before anything is read."""
    with wrong_usage():
        return dataclasses.replace(options, view=None if options.eye is not None else options.view or "z")


def _opened(options: Any, loaded: Loaded, transfer: TransferFunction | None = None) -> Opened:
    """How particles are seen, of a periodic set around what is to be in the middle: all, if no more is asked for; said."""
    particles: Any = loaded.shown
    if particles.box is not None and options.center is not None:
        with wrong_usage():
            place: Any = place_of(Scene(particles=particles), options.center, loaded.table)
        particles, options = particles.centered(place), dataclasses.replace(options, center=tuple(place.tolist()))
    scene = Scene(particles=particles, transfer=transfer)
    left_by(clip_of(options), scene)
    with wrong_usage():
        seen = framed(scene, options, loaded.table, whole=True)
    say_all(seen.said)
    labels = None if transfer is None else cli_scene.key_of(loaded, options)
    return Opened(scene, seen.camera, labels or Labels(), (), seen.center, seen.up)


@offered(without="color_by opacity_by preset transfer exposure optical_depth surface surface_of")
class Project(groups.Options, groups.Key, Look, View, Source):
    """Options of the command."""

    output: Path | None = output(f"{', '.join(WRITTEN)} (default: FILE's name with .exr, here)")
    of: str | None = option(
        None, "NAME", str, OWN, "mass, number, volume, a quantity or an expression (default: mass, else number)"
    )
    weight: str | None = option(
        None, "NAME", str, OWN, "a mean of --of along rays, by mass, number, volume, or a quantity times volume"
    )
    along: str | None = choice(None, ALONG, OWN, "what is made of --of along rays", " (default: mean with --weight, else sum)")
    emission: float | None = option(
        None, "N", values.number, OWN, "emission: the integral of density^N, times --of where that is given"
    )
    pixel: str = option(
        PIXELS[0], "mean|ray", values.one_of(PIXELS), OWN, "means of pixels, which keep all mass, or values of rays"
    )
    tolerance: float = option(
        0.0, "SHARE", values.number, OWN, "of a particle's peak: what interpolating wide ones may be off by"
    )
    arrows: str | None = option(
        None, "NAME", str, OUTPUT, "with --annotate: arrows of a vector, as velocity, its mean along rays"
    )
    depth_range: Any = option(None, "A,B", values.span, CAMERA, BETWEEN)
    norm: str | None = choice(None, NORMS, LOOK, "of a .png", " (default: log over a decade)")


def project(file: Annotated[str, Parameter(help="a file of particles")], /, *, asked: Project = Project()) -> None:
    """Project, write, and say.

    NAME is mass, volume, number (of particles), or any quantity of the file, as velocity.los, or an expression of them. Without
    --weight, mass is projected to a column density, number to a column number density, and the integral of any other quantity is
    taken along rays; --along max shows the largest value of the particles whose supports a ray meets.
    """
    options = dataclasses.replace(asked, source=file)
    if options.source.startswith(SCENE):
        raise UsageError(f"{file}: a projection is of a file of particles; `jaxsph render` shows built-in scenes")
    output = console.output_of(options, "a projection must be", WRITTEN, ".exr", of_pictures=OF_PICTURES)
    if options.arrows is not None and not console.has_key(options):
        raise UsageError("--arrows are drawn with a key: add --annotate")
    options = _flat(options)
    table = io.read_table(options.source, part_type=options.types[0][0], physical=options.physical)
    say("file", f"{options.source}: {table.source}, {len(table):,} particles")
    with wrong_usage(of=io.ConditionError):
        table = chosen(table, "density", *options.how, **options.which)
    particles, report = io.particles_from_table(table, "x", *options.how)
    console.say_report(report, particles.to_numpy()["support"])
    opened = _opened(options, Loaded(options.source, particles, options.of or MASS, table=table))
    particles = opened.scene.particle_set
    opened = dataclasses.replace(opened, camera=_through(opened.camera, options, particles))
    columns = _Columns(sighted(table, opened.camera, opened.camera.is_perspective, particles), particles)
    options = dataclasses.replace(options, of=columns.called(options.of), weight=columns.called(options.weight))
    with wrong_usage(of=io.ConditionError):
        of, weight, name, what = _asked(columns, options)
    say("values", what)
    left = Scene(particles=particles, within=clip_of(options))
    inside = np.asarray(particles_in(left)[1].valid)[: len(of)]
    if left.within is not None:
        say("clip", f"columns of the {int(inside.sum()):,} particles whose centres are inside, with all of their supports")
    code = columns.unit(options)
    factor, unit = _factor_of(code, options)

    def make() -> Made:
        clock, started = Eager(), time.perf_counter()
        asked = of, weight, name, "" if code is None else written(code)
        how: dict[str, Any] = {"pixel": options.pixel, "tolerance": options.tolerance, "along": options.along}
        image = projected(clock, left, opened.camera, asked, **how)
        said, results = _told_of(image, of[inside] if name.startswith(("column", "emission")) else None)
        if unit:
            image = dataclasses.replace(image, values=image.values * factor, unit=unit)
        if options.background is not None and image.weight is None:  # it is seen where there is nothing along a ray, as of means
            image = dataclasses.replace(image, weight=image.values)
        took = {stage: clock.seconds[stage] for stage in ("compile", "cast")}
        stats = {"seconds": {"plan": time.perf_counter() - started - sum(took.values()), **took}}
        there = np.asarray(image.values)[np.isfinite(image.values)]
        light = {"colormap": ON_LIGHT} if is_light(options.background) and (there >= 0).all() else {}
        look = light | {each: value for each in LOOKS if (value := getattr(options, each)) is not None}
        results |= {"name": name, "lowest": there.min(initial=np.inf), "highest": there.max(initial=-np.inf)}
        length, largest = table.units.length, float(np.abs(there).max(initial=0))
        shown = (1.0, unit or CODE_UNITS) if unit or code is None or not can_name() else named(code, largest, None, length)
        more = {"length_unit": options.length_unit, "weight": options.weight or ""}
        labels = Labels(name, shown[1], shown[0], length, moment=moment_of(table.units), **more)
        about = "image", f"{options.size[0]} x {options.size[1]}, {name} {span(there)}"
        arrows = None if options.arrows is None else columns.arrows(options.arrows, left, opened.camera)
        return Made(image, lambda image, path: image.save(path, **look), about, said, results, stats, look, labels, arrows)

    produce(options, output, opened, make)


def _through(camera: Camera, options: Any, particles: Particles) -> Camera:
    """A camera of columns: through all there is, or between the depths that are asked for."""
    camera = dataclasses.replace(camera, near=None, far=None)  # type: ignore[arg-type]
    if options.depth_range is None:
        return with_depths(camera, particles)
    ends, forward = np.asarray(options.depth_range), np.asarray(camera.axes, np.float64)[2]
    if not camera.is_perspective:  # coordinates along an axis, or towards where the picture is seen from
        axis = np.abs(forward) if (options.view or "z") in VIEWS else -forward
        ends = np.sort((ends - camera.exact_eye() @ axis) * (axis @ forward))
    elif not ends[0] > 0:
        raise UsageError(f"--depth-range must be > 0, as depths from the eye are, got {ends[0]:g}")
    near, far = (array_of(end, camera.dtype) for end in ends)
    return dataclasses.replace(camera, near=near, far=far)


def _told_of(image: Projection, of: np.ndarray | None) -> tuple[dict[str, str], dict[str, Any]]:
    """What is said of a projection, and its results; `of` amounts that add up in a picture."""
    said, results = {}, {}
    if image.cut > CUT_TOLD:
        said["depths"] = f"{image.cut:.1%} of what is in the picture lies outside of these depths"
    if of is not None and not image.perspective:
        total, of_all = float(image.total()), float(np.sum(of))
        said["total"], results = f"{total:.7g} in the image, of {of_all:.7g}", {"total": total, "of_all": of_all}
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

    def called(self, name: Any) -> Any:
        """A name, if any, that of a column of masses as `mass`: these are summed as they are, however the file calls them."""
        return MASS if self.mass_name is not None and plain(name or "") in map(plain, ROLES["mass"]) else name

    def values(self, name: str) -> np.ndarray:
        """A number a particle."""
        if name == NUMBER:
            return np.ones(len(self.table))
        if name == MASS and self.mass_name is None:
            raise UsageError("the file has no masses; project --of number, volume or a quantity")
        return self.volume if name == VOLUME else choose_quantity(self.table, name, density=self._settled.density)[0]

    def amounts(self, name: str) -> np.ndarray:
        """What is summed up of a name: masses and volumes as they are, others times volume."""
        return self.values(name) if name in SUMMED else self.values(name) * self.volume

    @functools.cached_property
    def density(self) -> np.ndarray:
        """As stored where that is the density, else summed over each particle's support."""
        stored = self._settled.stored
        return self._settled.density() if stored.column is None and stored.told else self.values("density")

    @functools.cached_property
    def volume(self) -> np.ndarray:
        """Those of the particles."""
        return self._settled.volumes()[0]

    def unit(self, options: Any) -> CodeUnit | None:
        """The unit of what is asked for, as far as the file states those that it is made of."""
        of_values = options.along in (*WEIGHED, "max") or (options.weight is not None and options.along is None)
        name = options.of or ("density" if of_values else MASS if self.mass_name else NUMBER)
        own, length = unit_of(self.table, (self.mass_name or MASS) if name == MASS else name), self.table.units.length
        if not of_values:
            own = CodeUnit(1.0, (0, 0, 0, 0)) if name in (NUMBER, VOLUME) else own
            own = own and length and own.over(length, 2 if name in (MASS, NUMBER) else -1)
        return None if options.emission is not None or is_log(name) else own

    def arrows(self, wanted: str, shown: Scene, camera: Camera) -> tuple[np.ndarray, np.ndarray, str, str]:
        """Components of a vector to the right and upwards, means along rays by mass, else by volume, its name and unit."""
        role = velocity_name(self.table) if plain(wanted) in map(plain, ROLES["velocity"]) else None
        name = self.table.named(wanted) or role
        vectors = [one for one in self.table.vectors if self.table.columns[one].shape[1] == 3]
        if name not in vectors:
            raise UsageError(f"--arrows {wanted}: there is no such vector; there are {', '.join(vectors) or 'none'}")
        weight = self.amounts(VOLUME if self.mass_name is None else MASS)
        coarse = dataclasses.replace(camera, width=ARROWS, height=max(1, round(ARROWS * camera.height / camera.width)))
        parts = self.table.columns[name].astype(np.float64) @ np.asarray(camera.axes, np.float64)[:2].T
        labels = io.labels_of(self.table, name, float(np.abs(parts).max(initial=0)))
        right, up = (
            np.asarray(projected(Eager(), shown, coarse, (part, weight, None, "")).values) * labels.factor for part in parts.T
        )
        return right, up, name, labels.unit


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
        return emission_measure(columns.values(MASS), columns.density, factor, options.emission), None, name, said
    if along in WEIGHED:
        of, weight = of or "density", options.weight or (NUMBER if columns.mass_name is None else MASS)
        said = f"{along} of {of} along rays, weighted by {weight}"
        return columns.values(of), columns.amounts(weight), f"{along}.{of}", said
    if along == "max":
        of = of or "density"
        return columns.values(of), None, f"max.{of}", f"the largest {of} of the particles whose supports a ray meets"
    of = of or (NUMBER if columns.mass_name is None else MASS)
    return columns.amounts(of), None, f"column.{of}", SUMMED.get(of, f"integral of {of} along rays: {of} times length")


@offered(without="opacity_by exposure optical_depth surface surface_of smoothing light occlusion antialias")
class Slice(groups.Options, groups.Key, Look, View, Source):
    """Options of the command."""

    color_by: str | None = option(None, "NAME", str, DATA, COLORED, "--of", "--color-by", "--quantity")
    weight: str | None = option(None, "NAME", str, OWN, "of a mean: mass, number, or a quantity times volume (default: volume)")
    plane: Any = option(
        None,
        "X,Y,Z,NX,NY,NZ",
        values.plane,
        OWN,
        "through X,Y,Z, seen from where NX,NY,NZ points to (default: through the middle)",
    )
    field: str | None = choice(
        None, FIELDS, OWN, "the normalised mean of the quantity, or what is summed over kernels", " (default: sum of a density)"
    )
    output: Path | None = output(f"{', '.join(WRITTEN)} (default: FILE's name with .png, here)")


def slice(file: Annotated[str, Parameter(help="a file of particles, or scene:NAME")], /, *, asked: Slice = Slice()) -> None:
    """Show the quantity on a plane, write, and say."""
    options = dataclasses.replace(asked, source=file)
    output = console.output_of(options, "an image must be", WRITTEN, ".png", of_pictures=OF_FIGURES)
    options = _flat(options)
    loaded, transfer = _sliced(options)
    opened = _opened(options, loaded, transfer)
    particles, seen, clip = opened.scene.particle_set, opened.camera, clip_of(options)
    _, up, forward = np.asarray(seen.axes, np.float64)
    center, plane, tall = opened.center, options.plane, None
    if center is None:
        center = np.mean(left_by(clip, particles).bounds(), 0)
    if opened.center is not None or clip is not None:
        away = float((center - seen.exact_eye()) @ forward) if seen.is_perspective else 1.0
        tall = 2 * float(seen.half_height) * away
    if plane is None:
        plane = Plane(tuple(center), tuple(-forward))
    else:
        up = upright(plane.normal, opened.up)
    frame = {"within": clip, "center": center, "up": up, "view_height": tall}

    weights, summed = _summed(loaded, options)
    weighted = particles if weights is None else carrying(particles, weights, False)[0]  # by which a mean is weighted

    def in_unit(values: Any) -> Any:
        """Values in the unit that is asked for."""
        factor = 1.0 if options.unit is None else opened.labels.factor
        return values + np.log10(factor) if is_log(loaded.quantity) else values * factor

    def save(what: Sliced, path: Path) -> None:
        look = dataclasses.replace(transfer, values=in_unit(transfer.values))
        dataclasses.replace(what, values=in_unit(what.values)).save(path, look)

    def make() -> Made:
        of: dict[str, Any] = {"of": summed, "normalised": summed is None}
        made = slice_of(weighted, plane, **frame, width=options.size[0], height=options.size[1], **of)
        if summed is not None:
            shown = np.where(made.values != 0, made.values, np.nan)  # outside of every support there is nothing to show
            made = dataclasses.replace(made, values=np.log10(shown) if is_log(loaded.quantity) else shown)
        there = np.isfinite(made.values)
        if not there.any() and particles.num_particles:
            raise ValueError(f"no particle reaches the plane; there are particles {ends_of(*particles.bounds())}")
        unit = None if loaded.table is None or is_log(loaded.quantity) else unit_of(loaded.table, loaded.quantity)
        if unit is not None:
            called = written(unit) if options.unit is None else opened.labels.unit
            made = dataclasses.replace(made, metadata=(*made.metadata, ("jaxsph.unit", called)))
        found, inside = in_unit(made.values[there]), float(there.mean())
        said = {"slice": f"{span(found)}, {inside:.1%} of the pixels inside of supports"}
        about = "image", f"{options.size[0]} x {options.size[1]}, {float(made.pixel_size):.6g} a pixel"
        results = {"inside": inside, "pixel_size": float(made.pixel_size)}
        results |= {"lowest": found.min(initial=np.inf), "highest": found.max(initial=-np.inf)}
        return Made(made, save, about, said, results, look={"transfer": transfer})

    produce(options, output, dataclasses.replace(opened, scene=Scene()), make)


def _summed(loaded: Loaded, options: Any) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Weights, of a mean by others than volumes; and what is summed over kernels: of a density masses, else the quantity times
    volumes, None of a mean. Said.
    """
    if loaded.table is None:
        if options.field == "sum" or options.weight is not None:
            raise UsageError("--field sum and --weight are for a file of particles, which has masses and volumes")
        return None, None
    name = loaded.quantity[len(LOG_PREFIX) :] if is_log(loaded.quantity) else loaded.quantity
    unit, is_density = unit_of(loaded.table, name), plain(name) in map(plain, ROLES["density"])
    is_sum = is_density or (unit is not None and unit.powers == (-3, 1, 0, 0))
    if options.weight is None and (options.field or FIELDS[is_sum]) == "mean":
        say("field", f"the normalised mean of {loaded.quantity}" + ", whose sum --field sum has" * is_sum)
        return None, None
    columns = _Columns(chosen(loaded.table, name, *options.how, **options.which), loaded.shown)  # type: ignore[arg-type]
    if options.weight is not None:
        weights = columns.amounts(columns.called(options.weight))
        require_positive("weight", weights, "means need weights that are not negative", strict=False)
        say("field", f"the mean of {loaded.quantity}, weighted by {options.weight}")
        return weights, None
    what = (NUMBER if columns.mass_name is None else MASS) if is_density else name
    say("field", f"{what if is_density else f'{name} times volume'} summed over kernels; --field mean has the normalised mean")
    return None, columns.amounts(what)


def _sliced(options: Any) -> tuple[Loaded, TransferFunction]:
    """The particles, and the colours of their quantity."""
    seen = options
    if options.plane is not None:  # a line of sight is against its normal
        along = tuple(np.asarray(options.plane.normal, np.float64))
        seen = dataclasses.replace(options, view=along, eye=None, target=None, fov_degrees=None)
    loaded, own, _ = cli_scene.loaded_of(seen, opacity=False)
    if not isinstance(loaded.shown, Particles):
        raise UsageError(f"{options.source}: a slice is of particles, and this is a volume")
    if own is not None and not cli_scene.is_looked(options):
        return loaded, own.looks[0]
    kind = PRESETS[options.preset or kind_of(loaded.quantity, cli_scene.values_of(loaded.shown))]
    if kind.lift and kind.domain == "log" and options.colormap is None and options.transfer is None:  # as nothing is clear there
        options = dataclasses.replace(options, colormap=kind.colormap + "_r" * is_light(options.background))
    return loaded, cli_scene.look(loaded.shown, options, loaded.quantity)
