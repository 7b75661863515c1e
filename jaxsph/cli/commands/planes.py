"""The command `slice`: a quantity on a plane through particles.

Flow: file or scene, options -> flat, amounts -> [planes] -> slice -> EXR, NPY, FITS or PNG.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from jaxsph.analysis.at_places import carrying
from jaxsph.analysis.slices import Slice as Sliced, slice as slice_of
from jaxsph.cli import figures, groups, scene as cli_scene
from jaxsph.cli.amounts import Amounts
from jaxsph.cli.console import SCENE, UsageError
from jaxsph.cli.flat import WRITTEN, along_a_line, opened_flat
from jaxsph.cli.groups import OWN, offered, output
from jaxsph.cli.voice import say, say_all
from jaxsph.io.images.planes import converted
from jaxsph.io.opening import values
from jaxsph.io.opening.looks import is_light, kind_of, values_of
from jaxsph.io.opening.opened import Loaded, Opened
from jaxsph.io.opening.options import COLORED, DATA, Look, Source, View, choice, option
from jaxsph.io.opening.views import (
    TURNED,
    clip_of,
    ends_of,
    flat_on,
    left_by,
    places_of,
)
from jaxsph.io.settle.around import shortest
from jaxsph.io.settle.assemble import chosen
from jaxsph.io.settle.quantities import (
    LOG_PREFIX,
    is_log,
    unit_of,
)
from jaxsph.io.table import has_role
from jaxsph.io.units import spoken, written
from jaxsph.model.camera.camera import Bounded
from jaxsph.model.camera.directions import UP
from jaxsph.model.clips import Plane
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.presets import PRESETS
from jaxsph.numerics.checks import require_positive

FIELDS = "mean", "sum"
BESIDE = 1e-2  # of a support, by which particles of a plane may lie beside it, as kernels are flat there


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
    figures.draw(along_a_line(options), output, _sliced)


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
    opened, clip = opened_flat(options, dataclasses.replace(loaded, table=table), like, transfer), clip_of(options)
    seen, loaded = opened.camera, dataclasses.replace(loaded, shown=opened.scene.particle_set)
    _, up, forward = seen.exact_axes()
    center = _center(opened, left_by(clip, loaded.shown), None if options.plane else forward)
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


def _center(opened: Opened, left: Bounded, forward: np.ndarray | None) -> np.ndarray:
    """What is in the middle; where no particle reaches the plane through it, moved along to the nearest, and said."""
    center = np.asarray(np.mean(left.bounds(), 0) if opened.center is None else opened.center)
    shown = opened.scene.particle_set
    if forward is None or not shown.num_particles:
        return center
    depth = np.where(shown.valid, (shown.exact_position() - center) @ forward, np.inf)
    if (np.abs(depth) < np.asarray(shown.support)).any():
        return center
    step = float(depth[np.argmin(np.abs(depth))])
    say("plane", f"moved by {abs(step):.6g} to the nearest particles, as none reach the middle")
    return np.asarray(center + step * forward)


def _on_plane(options: Any, loaded: Loaded, plane: Plane, frame: dict[str, Any], name: str | None = None) -> Sliced:
    """The quantity that is loaded, or one of another name, on a plane: NaN where there is none."""
    particles: Any = loaded.shown
    of = None
    if name is not None:
        of = Amounts(chosen(loaded.table, name, *options.how, **options.which), particles).values(name)  # type: ignore[arg-type]
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
    amounts = Amounts(chosen(loaded.table, name, *options.how, **options.which), loaded.shown)  # type: ignore[arg-type]
    if is_mean:  # of types, whose volumes overlap, by mass
        weight = options.weight or amounts.weighing
        weights = amounts.amounts(amounts.called(weight)) * amounts.thickness
        require_positive("weight", weights, "means need weights that are not negative", strict=False)
        say("field", f"the mean of {loaded.quantity}, weighted by {weight}")
        return weights, None
    what = amounts.weighing if is_density else name
    say("field", f"{what if is_density else f'{name} times volume'} summed over kernels; --field mean has the normalised mean")
    _require_within(plane, loaded)
    return None, amounts.amounts(what) * amounts.thickness


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
