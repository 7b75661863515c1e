"""The command `project`: column densities, means along rays and emission of a particle file; and contours of those over others.

Flow: file, options -> flat, amounts -> [columns] -> project -> EXR, NPY, FITS or PNG.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from jaxsph import io
from jaxsph.analysis.projection.plan import PIXELS, particles_in
from jaxsph.analysis.projection.project import ALONG, WEIGHED, projected
from jaxsph.cli import console, figures, groups
from jaxsph.cli.amounts import MASS, NUMBER, VOLUME, Amounts
from jaxsph.cli.console import SCENE, UsageError, units_of, wrong_usage
from jaxsph.cli.flat import WRITTEN, along_a_line, opened_flat
from jaxsph.cli.groups import OUTPUT, OWN, offered, output
from jaxsph.cli.voice import say, say_all
from jaxsph.engine.runtime.clock import Clock
from jaxsph.io import Labels
from jaxsph.io.images.planes import converted
from jaxsph.io.opening import values
from jaxsph.io.opening.looks import is_light
from jaxsph.io.opening.opened import Loaded, Opened, in_sight
from jaxsph.io.opening.options import CAMERA, LOOK, Look, Source, View, choice, option
from jaxsph.io.opening.part_types import read_together
from jaxsph.io.opening.views import (
    clip_of,
    flat_on,
    sighted,
)
from jaxsph.io.settle.assemble import SUPPORTS, WHOLE, chosen
from jaxsph.io.settle.quantities import (
    velocity_name,
)
from jaxsph.io.table import ROLES, CodeUnit, has_role, plain
from jaxsph.io.units import CODE_UNITS, can_name, moment_of, named, spoken, written
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.directions import VIEWS
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.particles.columns import emission_measure
from jaxsph.model.particles.particles import Particles
from jaxsph.model.projection import CUT_TOLD, NORMS, Projection
from jaxsph.model.scene import Scene
from jaxsph.numerics.checks import array_of

SUMMED = {
    MASS: "column density: mass a unit of area",
    VOLUME: "length inside particles: volume a unit of area",
    NUMBER: "particles a unit of area",
}
"""What particles hold themselves; anything else is held by their volume."""
LOOKS = "colormap", "norm", "range"
BETWEEN = "what lies between: coordinates along the --view, or depths from the --eye"
ARROWS = 20  # across a picture
ON_LIGHT = "heat_r"  # colours of what has no sign on a light background, from light to dark as those of other commands


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
    figures.draw(along_a_line(options), output, _projected)


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
    opened = opened_flat(options, Loaded(options.source, particles, options.of or MASS, table=table), like)
    particles = opened.scene.particle_set
    camera = _through(opened.camera, options, particles)
    amounts = Amounts(sighted(table, camera, camera.is_perspective, particles), particles)
    options = dataclasses.replace(options, of=amounts.called(options.of), weight=amounts.called(options.weight))
    with wrong_usage(of=io.ConditionError):
        of, weight, name, what = _asked(amounts, options)
    say("values", what)
    left = Scene(particles=particles, within=clip_of(options))
    inside = np.asarray(particles_in(left)[1].valid)[: len(of)]
    if left.within is not None:
        say("clip", f"columns of the {int(inside.sum()):,} particles whose centres are inside, with all of their supports")
    code, length = amounts.unit(options), table.units.length
    factor, unit = _factor_of(code, options)
    of_total = code and length and code.over(length, -2)

    def make() -> figures.Made:
        clock, started = Clock(), time.perf_counter()
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
        arrows = () if options.arrows is None else (_arrows_of(amounts, options.arrows, left, camera),)
        contours = None if options.contours is None else _contours_of(amounts, options, left, camera)
        return figures.Made(image, about, said, results, stats, look, labels, arrows, contours)

    return dataclasses.replace(opened, camera=camera, measures=(options.unit or written(code), written(length), name)), make


def _needs_volumes(options: Any, table: io.ParticleTable) -> bool:
    """Whether a projection is of more than masses or numbers, which need neither volumes nor densities."""
    of, masses = plain(options.of or MASS), map(plain, (NUMBER, *ROLES["mass"], table.of_role("mass") or MASS))
    others = options.weight, options.emission, options.arrows, options.contours
    return of not in masses or options.along not in (None, "sum") or any(other is not None for other in others)


def contours_over(options: Any, opened: Opened) -> tuple[np.ndarray, str, CodeUnit | None]:
    """Over a picture of a file of particles, and of all that is along its rays: those of `project`, see `_contours_of`."""
    if opened.scene.particles is None or options.source.startswith(SCENE):
        raise UsageError("--contours is for a file of particles, which has columns: leave it out")
    table, particles = in_sight(_table_of(options), options, options, options.contours), opened.scene.particle_set
    table = chosen(table, "density", *options.how, **options.which)
    if len(options.types) > 1:  # of which the picture has others beside the first
        box, particles = particles.box, io.particles_from_table(table, "x", *options.how)[0]
        particles = particles if box is None else particles.centered(np.mean(box.corners(), 0))
    table = table.rows(np.asarray(particles.valid)[: len(table)])  # without those that lie far from all others
    camera = with_depths(dataclasses.replace(opened.camera, near=None, far=None), particles)  # type: ignore[arg-type]
    amounts = Amounts(sighted(table, camera, camera.is_perspective, particles), particles)
    return _contours_of(amounts, options, dataclasses.replace(opened.scene, particles=particles), camera)


def _contours_of(amounts: Amounts, options: Any, shown: Scene, camera: Camera) -> tuple[np.ndarray, str, CodeUnit | None]:
    """Of what adds up along rays, or else of a mean along them: values, what they are called, and their unit."""
    name = amounts.called(options.contours)
    asked = Project(of=name, weight=None if name in SUMMED else getattr(options, "weight", None) or amounts.weighing)
    of, by, called, _ = _asked(amounts, asked)
    image = projected(Clock(), shown, camera, (of, by, called, ""), pixel=getattr(options, "pixel", asked.pixel))
    return np.asarray(image.values), called, amounts.unit(asked)


def _arrows_of(amounts: Amounts, wanted: str, shown: Scene, camera: Camera) -> tuple[np.ndarray, np.ndarray, str, str, float]:
    """Components of a vector to the right and upwards, means along rays by mass, else volume; its name, unit and factor."""
    role = velocity_name(amounts.table) if has_role(wanted, "velocity") else None
    name = amounts.table.named(wanted) or role
    vectors = [one for one in amounts.table.vectors if amounts.table.columns[one].shape[1] == 3]
    if name not in vectors:
        raise UsageError(f"--arrows {wanted}: there is no such vector; there are {', '.join(vectors) or 'none'}")
    weight = amounts.amounts(VOLUME if amounts.mass_name is None else MASS)
    coarse = dataclasses.replace(camera, width=ARROWS, height=max(1, round(ARROWS * camera.height / camera.width)))
    parts = amounts.table.exact(name) @ camera.exact_axes()[:2].T
    labels = io.labels_of(amounts.table, name, float(np.abs(parts).max(initial=0)))
    right, up = (np.asarray(projected(Clock(), shown, coarse, (part, weight, None, "")).values) for part in parts.T)
    return right, up, name, labels.unit, labels.factor


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


def _asked(amounts: Amounts, options: Any) -> tuple[np.ndarray, np.ndarray | None, str, str]:
    """Amounts or values, weights, the name of the result, and a sentence about it."""
    of, along = options.of, options.along or ("sum" if options.weight is None else "mean")
    if options.weight is not None and along not in WEIGHED:
        raise UsageError(f"--weight is for a mean or a dispersion along rays: leave it out of --along {along}")
    if options.emission is not None and options.along not in (None, "sum"):
        raise UsageError(f"--emission is a sum along rays: leave out --along {along}")
    if options.emission is not None:
        factor, times, name = (1.0, "", "emission") if of is None else (amounts.values(of), f"{of} x ", f"emission.{of}")
        said = f"integral of {times}density^{options.emission:g} along rays, each particle with its own density"
        return emission_measure(amounts.amounts(MASS), amounts.density, factor, options.emission), None, name, said
    if along in WEIGHED:
        of, weight = of or "density", options.weight or amounts.weighing
        said = f"{along} of {of} along rays, weighted by {weight}"
        return amounts.values(of), amounts.amounts(weight), f"{along}.{of}", said
    if along == "max":
        of = of or "density"
        return amounts.values(of), None, f"max.{of}", f"the largest {of} of the particles whose supports a ray meets"
    of = of or amounts.weighing
    return amounts.amounts(of), None, f"column.{of}", SUMMED.get(of, f"integral of {of} along rays: {of} times length")
