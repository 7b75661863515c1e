"""The front door: a file becomes a scene and a camera, as `jaxsph render FILE` shows it.

Flow: file -> [load] -> Loaded -> [staged: look, exposure, view] -> Opened: Scene, Camera, Labels, what was chosen; `read_scene`
does both.

The look comes first, with the extinction of typical columns; then the view is framed by what that look lights up; then extinction
is fitted to the picture itself (`jaxsph.model.preview.glimpse`).
"""

from __future__ import annotations

import dataclasses
import functools
import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.opening.looks import (
    by_logarithm,
    is_light,
    look_of,
    surface_of,
    told_of_surface,
    transfer_of,
    values_of,
    within_surface,
)
from jaxsph.io.opening.options import Look, Source, View
from jaxsph.io.opening.part_types import read_types, together
from jaxsph.io.opening.rest_frame import in_frame
from jaxsph.io.opening.values import in_lengths_of
from jaxsph.io.opening.views import (
    TURNED,
    Framed,
    Said,
    clip_of,
    flat_on,
    framed,
    in_period,
    place_of,
    places_of,
    sighted,
    toward,
    written_place,
)
from jaxsph.io.settle.around import names_center
from jaxsph.io.settle.assemble import AUTO, SUPPORTS, WHOLE, Report, chosen, particles_from_table
from jaxsph.io.settle.matching import drawn
from jaxsph.io.settle.points import glow
from jaxsph.io.settle.quantities import SIGHT, is_log
from jaxsph.io.table import CodeUnit, ParticleTable
from jaxsph.io.units import MEASURED, Labels, can_name, labels_of as labels_from, stated_length
from jaxsph.io.volumes.volume_files import is_volume, nothing_there, read_volume_table, volume_from_table
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.directions import UP
from jaxsph.model.clips import both
from jaxsph.model.particles.coincident import one_a_place
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import Points
from jaxsph.model.preview.frame import across_faces, flat_along, without_strays
from jaxsph.model.preview.glimpse import exposure, glimpse, levelled
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction, scaled
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import array_of
from jaxsph.numerics.names import did_you_mean

GROUPS = (Source, Look, View)


@dataclasses.dataclass(frozen=True, eq=False)
class Loaded:
    """What a file gives to a picture: particles or a volume.

    Attributes:
        path: the file; empty of what was made in memory.
        shown: the particles or the volume.
        quantity: full name of what colours are looked up by.
        opacity_by: full name of what extinction is looked up by, where that is another.
        table: of the particles that are shown, where there is one.
        report: how the particles were settled.
        said: what was chosen, for people: pairs of a word and a sentence.
        colormap: the colour map that was asked for with the type of particles.
        beside: particles of other types that share the picture.
    """

    path: str
    shown: Particles | Volume
    quantity: str
    opacity_by: str | None = None
    table: ParticleTable | None = None
    report: Report | None = None
    said: tuple[tuple[str, str], ...] = ()
    colormap: str | None = None
    beside: tuple[Points, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Opened:
    """A picture before it is rendered.

    Attributes:
        scene: with its look and its clips.
        camera: framed.
        labels: for a key.
        said: what was chosen, for people: pairs of a word and a sentence.
        center: (3,) what is in the middle of the picture, where that or a width was asked for.
        up: (3,) which way is up.
        measures: in which units values and lengths are, and what the values are, where the quantity does not say it.
    """

    scene: Scene
    camera: Camera
    labels: Labels
    said: tuple[tuple[str, str], ...]
    center: np.ndarray | None = None
    up: Any = UP
    measures: tuple[str, ...] = ()


def read_scene(
    path: str | os.PathLike[str],
    *,
    color_by: str | None = None,
    opacity_by: str | None = None,
    center: Any = None,
    width: Any = None,
    view: Any = None,
    size: tuple[int, int] = (512, 512),
    **more: Any,
) -> tuple[Scene, Camera]:
    """A scene and a camera that show a file: what `jaxsph render FILE` shows with the same options, bit for bit.

    What is not said is chosen: the quantity by what the file holds, colours by the kind of quantity, the camera such that what is
    lit fills the picture, extinction such that the brightest of it is nearly opaque.

    Args:
        path: a file of particles or of a volume.
        color_by: quantity that colours are looked up by.
        opacity_by: quantity that extinction is looked up by; over more than a decade its logarithm is taken.
        center: x, y and z in the file's lengths, `"densest"` or `"mass"`.
        width: across the picture, a length of the file or with a unit, `"30 kpc"`; or `"all"`.
        view: `"x"`, `"y"`, `"z"`, `"iso"`, `"face-on"` or `"edge-on"`; or x, y and z, from where these point to.
        size: width and height of the picture in pixels.
        more: any other attribute of `jaxsph.io.opening.options.Source`, `Look` and `View`, such as `where=`, `colormap=`, `eye=`.

    Returns:
        What `jaxsph.render` takes. Of parallel rays near and far are None, and `camera.near_and_far()` are those of the picture.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: what cannot be read, or an option that does not suit the file.
        ImportError: a library that the format needs is not installed.
        TypeError: an option that there is not.
    """
    given = {"color_by": color_by, "opacity_by": opacity_by, "center": center, "width": width, "view": view, "size": size} | more
    fields = [field for group in GROUPS for field in dataclasses.fields(group)]
    known = [field.name for field in fields]
    for wrong in (name for name in given if name not in known):
        raise TypeError(f"read_scene has no option {wrong!r}; there are {', '.join(known)}{did_you_mean(wrong, known)}")
    for field in fields:
        if (text := _length_text(given.get(field.name))) is not None and field.name not in ("width", "support"):
            given[field.name] = field.metadata["read"](text)
    groups: Any = [(group, [field.name for field in dataclasses.fields(group) if field.name in given]) for group in GROUPS]
    source, look, seen = (group(**{name: given[name] for name in own}) for group, own in groups)
    source, seen = (in_own_lengths(group, path, source) for group in (source, seen))
    opened = staged(load(path, source, look, seen), look, seen, source=source)
    camera = opened.camera
    if not camera.is_perspective:
        depths = array_of(np.array(camera.near_and_far()), camera.dtype)
        camera = dataclasses.replace(camera, near=None, far=None, snug=depths)  # type: ignore[arg-type]
    return opened.scene, camera


def _length_text(value: Any) -> str | None:
    """A place or a shape as text, as the command line takes it, where any of its lengths has a unit; else None."""
    parts = value if isinstance(value, tuple | list) else (value,)
    text = ",".join(map(str, parts)) if any(isinstance(one, str) for one in parts) else ""
    return text if MEASURED.search(text) else None


def in_own_lengths(options: Any, path: Any, source: Any) -> Any:
    """Convert lengths with units in options to numbers in the unit of the file, which is read only where there are any."""

    @functools.cache
    def unit() -> CodeUnit | None:
        wanted = getattr(options, "length_unit", None)
        if not Path(path).exists() or is_volume(path):
            return None if wanted is None else stated_length(wanted)
        own = read_types(path, source.types, source.physical)[0][0].table.units.length
        return stated_length(wanted) if own is None and wanted is not None else own

    return in_lengths_of(options, unit)


def load(
    path: str | os.PathLike[str],
    source: Source | None = None,
    look: Look | None = None,
    view: View | None = None,
    *,
    effort: str = WHOLE,
    joined: bool = False,
) -> Loaded:
    """The particles or the volume of a file (host side); where a look says all of it, opacity has a quantity only by its name.

    A `view` is for components along the line of sight, see `in_sight`; `effort` is that of `particles_from_table`. Of several
    types of particles the first is shown, with the others beside it as points; `joined` they are one set, see
    `jaxsph.io.opening.part_types.together`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: what cannot be read, or options that the file does not suit; the message names the file.
        ImportError: a library that the format needs is not installed.
    """
    source, look = source or Source(), look or Look()
    if is_volume(path):
        if source.of_particles:
            raise ValueError(f"`{source.of_particles[0]}` is for particles, and {path} is a volume; leave it out")
        volume, name = volume_from_table(read_volume_table(path), source.color_by)
        missing = nothing_there(volume)
        return Loaded(str(path), volume, name, said=(("missing", missing),) if missing else ())
    (first, *others), notes = read_types(path, source.types, source.physical)
    if joined and others:
        first, others = first._replace(table=together([first, *others], *source.how, source.box)), []
    table = first.table.with_notes(*notes)
    if source.share is not None:
        others = [one._replace(table=drawn(one.table, None, source.share)[0]) for one in others]
    beside = [glow(one.table, one.called, one.look, table.position) for one in others]
    more_names = (getattr(source, name, None) for name in ("weight", "contours"))
    table = in_sight(table, source, view, source.color_by, source.opacity_by, look.surface_of, *more_names)
    if look.surface_of is not None and source.opacity_by is not None:
        raise ValueError("`surface_of` and `opacity_by` exclude each other: a surface has no extinction; leave one of them out")
    given = transfer_of(look)
    opacity_by = look.surface_of or source.opacity_by or (AUTO if given is None or given.extinction_values is not None else None)
    how, which = source.how, source.which
    particles, report = particles_from_table(table, source.color_by, *how, **which, opacity_by=opacity_by, effort=effort)
    if look.surface_of is not None:
        report = dataclasses.replace(report, opacity_by=None)
    named = None if opacity_by in (None, AUTO) else report.opacity_by
    particles, renamed = by_logarithm(particles, named)
    each = zip(others, beside, strict=True)
    said: Said = [("beside", f"{points.num_points:,} of {one.called}, {words}") for one, (points, words) in each]
    if renamed != named:
        said.append(("opacity", f"by the logarithm of {named}, which spreads over more than a decade"))
        report = dataclasses.replace(report, opacity_by=renamed)
    more: dict[str, Any] = {"colormap": first.look, "beside": tuple(points for points, _ in beside)}
    return Loaded(str(path), particles, report.quantity, report.opacity_by, table, report, tuple(said), **more)


def in_sight(table: ParticleTable, source: Source, view: View | None, *names: str | None) -> ParticleTable:
    """A table whose vectors have a component along the line of sight of a view, where any name or condition asks for one: along
    rays from its eye, else along the middle of the picture; as of all particles, where a condition does.

    Radii are from the center of the view, and velocities relative to those of the frame that is asked for.
    """
    table = in_frame(table, source.frame, source.box)
    if view is None:
        return table
    asks = [SIGHT in (name or "").lower() for name in (*names, source.where)]
    around = [view.center is not None and names_center(name or "") for name in (*names, source.where)]
    if not any(asks + around):
        return table
    which = source.which | ({"where": None} if asks[-1] or around[-1] else {})
    rows = chosen(table, "x", *source.how, **which, volumes=False)
    whole = Scene(particles=particles_from_table(rows, "x", *source.how, effort=SUPPORTS)[0])
    if any(around):
        table = dataclasses.replace(table, center=place_of(whole, view.center, rows))
    if not any(asks):
        return table
    view, _ = flat_on(view, table.position, table.box_size, table.up)
    if view.center is not None:
        whole, view, _ = _in_one_piece(whole, view, rows, None)
    return sighted(table, framed(whole, view, rows, whole=True).camera, view.eye is not None, whole.particle_set)


def staged(
    loaded: Loaded,
    look: Look | None = None,
    view: View | None = None,
    *,
    source: Source | None = None,
    beside: Scene | None = None,
    labels: Labels | None = None,
    camera: Camera | None = None,
) -> Opened:
    """The scene and the camera of what a file gives; what was not asked for is chosen.

    `source`, by which it was loaded, is for masses and velocities; volumes and points `beside` share the picture; without
    `labels` a key is by what the file states; a `camera` is taken as it is.

    Raises `ValueError`: options that do not suit what is there.
    """
    look, view = look or Look(), view or View()
    strays = 0
    if is_free(view) and isinstance(loaded.shown, Particles):
        together, strays = without_strays(loaded.shown)  # without particles far from all others
        loaded = dataclasses.replace(loaded, shown=together) if strays else loaded
    piled: Said = []
    if getattr(source, "contours", None) is None:  # which are of rows of the table
        loaded, piled = _of_places(loaded)
    if loaded.colormap is not None and look.colormap is None and look.transfer is None:
        look = dataclasses.replace(look, colormap=loaded.colormap)
    surface = surface_of(loaded.shown, loaded.report, look, source, clipped=bool(view.clips))
    colored: Any = loaded.shown
    colored = colored if surface is None else dataclasses.replace(colored, extinction_quantity=None)
    shaded = look if surface is None else dataclasses.replace(look, background=None)
    transfer, called = look_of(colored, loaded.quantity, shaded, by_log=is_log(loaded.opacity_by))
    scene = _scene_of(loaded.shown, transfer, beside)
    rows, source = loaded.table, source or Source()
    if rows is not None and (view.view in TURNED or view.center == "mass"):
        # those shown, where masses and velocities are looked at
        rows = chosen(rows, "x", *source.how, **source.which, volumes=False)
    scene, view, moved = _in_one_piece(scene, view, rows, beside)
    if scene.particles is not None and len(scene.parts) == 1 and camera is None:
        view, notes = flat_on(view, *places_of(scene.particles), UP if rows is None else rows.up)
        moved = [*moved, *notes]
    if surface is None and camera is None and is_free(view) and (rows is None or rows.sight is None):
        view, moved = _facing(scene, view, rows, moved)
    scene = _with_points(scene, loaded)
    lit = scene if surface is None else dataclasses.replace(scene, particles=within_surface(scene.particle_set, surface))
    seen_from = framed(lit, view, rows, strays=strays) if camera is None else Framed(camera, clip_of(view), [])
    camera, clip, notes, center, up = seen_from
    scene, said = dataclasses.replace(scene, within=both(scene.within, clip)), [*moved, *notes]
    if surface is None:
        scene = exposed(scene, camera, look)
        if (look.transfer, look.range, look.norm) == (None, None, None) and scene.particles is not None and not scene.volumes:
            scene = levelled(scene, camera)
    else:
        scene = dataclasses.replace(scene, surface=surface)
        said = [("surface", told_of_surface(surface, look)), *said]
    values = np.asarray(scene.looks[0].values)
    span = f"{float(values[0]):.6g} .. {float(values[-1]):.6g}"
    said = [*loaded.said, *piled, ("colours", f"{called} over {loaded.quantity} = {span}"), *said]
    return Opened(scene, camera, labels or labels_of(loaded), tuple(said), center, up)


def _with_points(scene: Scene, loaded: Loaded) -> Scene:
    """The scene with the other types of particles as points, moved by whole periods to where its particles are."""
    box = scene.particle_set.box
    for points in loaded.beside:
        if box is not None:
            lower, upper = box.corners()
            place = array_of(lower + np.mod(points.exact_position() - lower, upper - lower), points.position.dtype)
            points = dataclasses.replace(points, position=place, position_rest=None)
        scene = dataclasses.replace(scene, points=(*scene.point_sets, points))
    return scene


def _of_places(loaded: Loaded) -> tuple[Loaded, Said]:
    """Particles of which many share a place as one a place, and a sentence on that."""
    if not isinstance(loaded.shown, Particles):
        return loaded, []
    one_each, number = one_a_place(loaded.shown)
    places = one_each.num_particles
    if number == places:
        return loaded, []
    count = f"{number:,} particles share {places:,} place{'' if places == 1 else 's'}"
    said = ("places", f"{count}: those of one place and support are drawn as one, with the sum of their volumes")
    return dataclasses.replace(loaded, shown=one_each), [said]


def is_free(view: View) -> bool:
    """Whether nothing says what is in the picture."""
    return view.eye is None and view.center is None and view.width is None and not view.frame_all and view.clips is None


def _facing(scene: Scene, view: View, table: ParticleTable | None, said: Said) -> tuple[View, Said]:
    """A view from where what is flat, as a disc or a plane, is seen as a whole, where nothing says from where."""
    axis = None if view.view is not None or view.fov_degrees is not None else flat_along(scene)
    if axis is None:
        return view, said
    direction = toward(axis, view.up if view.up is not None else UP if table is None else table.up)
    words = f"from {written_place(direction)}, face-on, as what is shown is flat; --view iso is obliquely from above"
    return dataclasses.replace(view, view=direction), [*said, ("view", words)]


def _in_one_piece(scene: Scene, view: View, table: ParticleTable | None, beside: Scene | None) -> tuple[Scene, View, Said]:
    """A periodic set with its period around what is to be in the middle; or, where nothing says that, around matter that lies
    across faces: eyes and clips are placed among coordinates as they are, and so is what shares the picture.
    """
    if scene.particles is None or scene.particles.box is None:
        return scene, view, []
    said: Said = []
    particles, view = in_period(scene, view, table)
    free = view.center is None and view.eye is None and not view.clips and not (beside and beside.parts)
    if free and (place := across_faces(scene)) is not None:
        particles = particles.centered(place)
        said = [("box", f"its middle is {written_place(place)}, as what is shown lies across its faces")]
    return dataclasses.replace(scene, particles=particles), view, said


def exposed(scene: Scene, camera: Camera, look: Look) -> Scene:
    """The scene with the extinction of its first look fitted to the picture, as far as the look leaves that open."""
    own = look.transfer is not None or look.optical_depth is not None
    factor = (1.0 if own else exposure(glimpse(scene, camera), is_light(look.background))) * 2.0**look.exposure
    if factor == 1.0:
        return scene
    name = "transfer" if scene.particles is not None else "volume_transfer"
    value = getattr(scene, name)
    brighter: Any = scaled(value, factor) if not isinstance(value, tuple) else (scaled(value[0], factor), *value[1:])
    return dataclasses.replace(scene, **{name: brighter})


def _scene_of(shown: Particles | Volume, transfer: TransferFunction, beside: Scene | None) -> Scene:
    """What is shown, and what shares its picture."""
    more = Scene() if beside is None else beside
    if isinstance(shown, Particles):
        return dataclasses.replace(more, particles=shown, transfer=transfer)
    looks = ((shown, transfer), *more.volumes)
    volumes, transfers = zip(*looks, strict=True)
    return dataclasses.replace(more, volume=tuple(volumes), volume_transfer=tuple(transfers))


def labels_of(loaded: Loaded, unit: str | None = None, length_unit: str | None = None) -> Labels:
    """What a key says, in the units that are asked for, else as far as the file states them and they can be named.

    Raises `ValueError`: a unit that does not agree, or that is not stated.
    """
    if loaded.table is None or not (can_name() or unit or length_unit):
        return Labels(loaded.quantity, opacity=loaded.opacity_by or Labels.opacity)
    values = values_of(loaded.shown)
    largest = float(np.abs(values).max(initial=0)) or 1.0
    if is_log(loaded.quantity) and values.size:
        largest = 10.0 ** float(values.max())
    labels = labels_from(loaded.table, loaded.quantity, largest, unit=unit, length_unit=length_unit)
    return dataclasses.replace(labels, opacity=loaded.opacity_by or labels.opacity)
