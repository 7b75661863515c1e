"""What a command shows: its scene, from files and names, what it looks like, the camera that looks at it, and its key.

Flow: options -> [scene] -> `jaxsph.io.opening` -> Scene, Camera, Labels -> commands; survey -> Snapshots -> movie, view.

A file is opened as `jaxsph.io.read_scene` opens it, bit for bit. A built-in scene comes with its own look and camera. A sequence
of files has one look, said on the way.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph import io, scenes
from jaxsph.cli import parts as cli_parts
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import (
    UsageError,
    is_given,
    progress,
    refuse,
    require_writable,
    say_notes,
    say_report,
    span,
    written_place,
    wrong_usage,
)
from jaxsph.cli.options.values import read_as, with_options
from jaxsph.cli.voice import report, say
from jaxsph.engine.media.surfaces.iso_surface import IsoSurface
from jaxsph.io import Labels, ParticleTable
from jaxsph.io.damage import require
from jaxsph.io.opening import options as opening
from jaxsph.io.opening.looks import coloured_of, look_of, surface_of, told_of_surface
from jaxsph.io.opening.opened import Loaded, Opened, exposed, load, staged
from jaxsph.io.opening.views import framed
from jaxsph.io.replace import write_figure
from jaxsph.io.settle.assemble import AUTO
from jaxsph.io.settle.quantities import LOG_PREFIX
from jaxsph.io.units import NEEDS, can_name, stated_length, unit_of
from jaxsph.model import Camera, Image, Particles, Scene, TransferFunction, Volume
from jaxsph.model.camera.camera import Bounded
from jaxsph.model.clips import both
from jaxsph.model.preview.frame import across_faces, bulk_of_period
from jaxsph.model.scene import Surface
from jaxsph.model.transfer.looks import scaled
from jaxsph.model.transfer.maps import Scale
from jaxsph.plot.image_figure import image_figure
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.sequence.survey import Survey, surveyed

SCENE = "scene:"
"""What the name of a built-in scene begins with."""
UNITS = "unit", "length_unit"
FIGURES = (".png", ".pdf", ".svg")
ISO_COLOR = 0.85, 0.8, 0.7
OF_SCENES = {"particles": read_as("a whole number of particles")(int), "frame": read_as("a number as frame")(float)}
"""What stands behind the name of a built-in scene."""
OF_SOURCE = ("color_by", "opacity_by", "support", "kernel", "part_type", "where", "share", "iso", "surface", "surface_of")


def stem_of(source: str) -> str:
    """The name of a picture: that of its source, without a suffix; a number behind a point is none, as in `snap.00001`."""
    if source.startswith(SCENE):
        return source.split(":")[1]
    path = Path(source)
    return path.name if path.suffix[1:].isdecimal() else path.stem


def require_something(options: Any) -> None:
    """Raise `UsageError` where there is nothing to show."""
    if options.source is None and not options.points and not options.volume:
        raise UsageError("a particle file, a volume or scene:NAME is needed as FILE, or --points FILE, or --volume FILE")


def scene_of(options: Any) -> tuple[Scene, Camera, Labels]:
    """The source, and what else shares its picture; the camera; and labels of what it shows."""
    opened = opened_of(options)
    return opened.scene, opened.camera, opened.labels


def opened_of(options: Any) -> Opened:
    """The same, with all that was chosen."""
    volumes, points = cli_parts.volumes_of(options), cli_parts.points_of(options)
    parts: list[tuple[str, Any]] = [*((path, volume) for path, volume, _ in volumes), *points]
    beside = Scene(
        volume=tuple(volume for _, volume, _ in volumes) or None,
        volume_transfer=tuple(look for *_, look in volumes) or None,
        points=tuple(made for _, made in points) or None,
        mix=getattr(options, "mix", None) or Scene().mix,
    )
    if parts and not cli_where.is_placed(options):
        options = dataclasses.replace(options, frame_all=True)
    if options.source is None:
        opened, shown = _no_source(options, beside)
    elif options.source.startswith(SCENE):
        opened, shown = _scene_of_name(options, beside)
    else:
        opened, shown = _file(options, beside)
    if parts:
        cli_parts.warn_apart([*shown, *parts], options.command)
    report(particles=opened.scene.particle_set.num_particles if opened.scene.particles is not None else 0)
    return opened


Shown = list[tuple[str, Bounded]]


def _no_source(options: Any, beside: Scene) -> tuple[Opened, Shown]:
    """Parts alone."""
    refuse(options, OF_SOURCE, "is for FILE or scene:NAME, and there is none")
    if is_looked(options):
        name = next(iter(options.said), "transfer" if options.transfer is not None else "exposure")
        refuse(options, (name,), "is for FILE or scene:NAME, and there is none")
    with wrong_usage():
        camera, clip, _, center = framed(beside, options)
    return Opened(dataclasses.replace(beside, within=clip), camera, Labels(), (), center), []


def named_scene(options: Any) -> tuple[str, Scene, Camera]:
    """The built-in scene of `scene:NAME:particles=N,frame=K`, its name, and its camera."""
    refuse(options, options.of_particles + ("iso", "color_by", "surface_of"), "is for particle files, not for built-in scenes")
    width, height = getattr(options, "size", (512, 512))
    with wrong_usage():
        asked = with_options(OF_SCENES)(options.source)
        name, behind = asked.file.removeprefix(SCENE), asked.options
        made, camera = scenes.load(name, behind.get("particles"), behind.get("frame"), width=width, height=height)
    return name, made, camera


def _scene_of_name(options: Any, beside: Scene) -> tuple[Opened, Shown]:
    name, scene, camera = named_scene(options)
    particles = scene.particle_set
    say("scene", f"{name}, {particles.num_particles:,} particles, support {span(particles.to_numpy()['support'])}")
    looked, center = is_looked(options), None
    if looked:
        with wrong_usage():
            transfer, called = look_of(particles, "concentration", options)
        say("colours", f"{called} over concentration = {span(transfer.values)}")
        scene = dataclasses.replace(scene, transfer=transfer)
    labels = labels_of(Loaded(options.source, particles, "concentration"), options) or Labels()
    shared = {name: getattr(beside, name) for name in ("volume", "volume_transfer", "points", "mix")}
    scene = dataclasses.replace(scene, **shared)
    with wrong_usage():
        if cli_where.is_placed(options):
            camera, clip, said, center = framed(scene, options)
            for what, text in said:
                say(what, text)
        else:
            clip = cli_where.clip_of(options)
        scene = dataclasses.replace(scene, within=both(scene.within, clip))
        if looked:
            scene = exposed(scene, camera, options)
    if getattr(options, "surface", None) not in (None, False):
        scene = dataclasses.replace(scene, surface=Surface(options.surface))
        say("surface", f"where the coverage by particles is {options.surface:g}")
    return Opened(scene, camera, labels, (), center), [(options.source, particles)]


def _file(options: Any, beside: Scene) -> tuple[Opened, Shown]:
    """A file of particles or of a volume, as `io.read_scene` opens it."""
    loaded = loaded_of(options)
    labels = labels_of(loaded, options)
    with wrong_usage():
        opened = staged(loaded, options, options, source=options, beside=beside, labels=labels)
    cli_where.left_by(cli_where.clip_of(options), opened.scene.particles or loaded.shown)  # refuses clips that leave nothing
    for what, text in opened.said:
        say(what, text)
    if getattr(options, "iso", None) is None:
        say_left_out(opened.scene.looks[0], values_of(loaded.shown))
    else:
        assert isinstance(loaded.shown, Volume)
        color = ISO_COLOR if options.colormap is None else tuple(scenes.colormap(options.colormap)[-1])
        say("surface", f"where the values are {options.iso:g}")
        surface = IsoSurface.from_volume(loaded.shown, options.iso, color)  # seen from where the volume would be
        opened = dataclasses.replace(opened, scene=dataclasses.replace(beside, media=(surface,), within=opened.scene.within))
    return opened, [(options.source, loaded.shown)]


def loaded_of(options: Any, *, opacity: bool = True) -> Loaded:
    """What the file gives to a picture, and what was chosen of it, said; with a quantity of `opacity` where there is one."""
    if io.is_volume(options.source):
        refuse(options, (*options.of_particles, "surface", "surface_of"), "is for particles, and this is a volume")
        volume, name = cli_parts.volume_of_file(options.source, options.color_by)
        return Loaded(str(options.source), volume, name)
    refuse(options, ("iso",), "is for volumes, and this is a particle file")
    with wrong_usage(of=io.ConditionError):
        loaded = load(options.source, options, options)
    if not opacity:
        shown: Any = loaded.shown
        loaded = dataclasses.replace(loaded, shown=dataclasses.replace(shown, extinction_quantity=None), opacity_by=None)
    table: Any = loaded.table
    if table.units.length is None and getattr(options, "length_unit", None) is not None:
        with wrong_usage():
            units = dataclasses.replace(table.units, length=stated_length(options.length_unit))
        loaded = dataclasses.replace(loaded, table=dataclasses.replace(table, units=units))
        say("note", f"lengths are in {options.length_unit}, as --length-unit says: the file does not")
    say("file", f"{options.source}: {table.source}, {len(table):,} particles")
    say_chosen(loaded)
    return loaded


def say_chosen(loaded: Loaded, known: Collection[str] = ()) -> None:
    """Say what was chosen of the particles of a file, but for notes that are `known`."""
    taken: Any = loaded.report
    columns = loaded.shown.to_numpy()  # type: ignore[union-attr]
    say_report(taken, columns["support"])
    say("quantity", f"{loaded.quantity}, {span(columns['quantity'])}")
    if loaded.opacity_by is not None:
        say("opacity", f"by {loaded.opacity_by}, {span(columns.get('extinction_quantity', columns['quantity']))}")
    say_notes(note for note in taken.notes if note not in known)


def snapshots_of(options: Any, *, gaps: bool, strict: bool) -> tuple[Snapshots, Camera, Bounded]:
    """The snapshots and their look, as said on the way; a camera, and what there ever is."""
    for path in options.source:
        if path.startswith(SCENE) or (Path(path).exists() and io.is_volume(path)):
            raise UsageError(f"a sequence is one of particle files, but there is {path}; give it alone")
    refuse(options, ("iso", "volume", "points", "mix"), "is not for a sequence of particle files")
    by = options.surface_of or options.opacity_by or (None if options.transfer is not None else AUTO)
    said = {field.name: getattr(options, field.name) for field in dataclasses.fields(opening.Source)}
    source = opening.Source(**said | {"opacity_by": by})
    with progress("read", " files") as show, wrong_usage(of=io.ConditionError):
        try:
            survey = surveyed(options.source, source, gaps=gaps, strict=strict, progress=show)
        except ValueError as error:
            if "missing" in str(error) and not gaps:
                raise ValueError(f"{error}; --gaps goes on without") from error
            raise
    _say_survey(survey)
    options = cli_where.upward(options, survey.report.up, survey.report.source)
    looks = options if options.transfer is not None else dataclasses.replace(options, range=options.range or survey.span)
    surface = surface_of(survey.middle, survey.report, options, options, clipped=bool(options.clips))
    colored = survey.middle if surface is None else coloured_of(survey.middle)
    transfer = look(colored, looks, survey.quantity)
    of_range = "as asked for" if options.range else f"nearly all values of all {len(survey.files)} snapshots"
    say("", f"for all frames; range: {of_range}; extinction: by {survey.report.path}")
    center, middle = cli_where.middle_of(survey, options), Scene(particles=survey.middle, transfer=transfer)
    if center is None and options.eye is None and not options.clips and (place := across_faces(middle)) is not None:
        center = tuple(place.tolist())
        say("box", f"its middle is {written_place(center)}, as what is shown lies across its faces")
    if surface is not None:
        say("surface", f"{told_of_surface(surface, options)}; all frames alike, by {survey.report.path}")
    snapshots = Snapshots(survey, transfer, center, cli_where.clip_of(options), surface)
    placed = dataclasses.replace(options, center=None) if center is not None else options
    if center is not None:
        middle = dataclasses.replace(middle, particles=survey.middle.centered(center))
    shown = (None if options.clips or options.eye is not None else bulk_of_period(middle)) or snapshots
    return snapshots, cli_where.camera_of(shown, placed), cli_where.left_by(snapshots.within, shown)


def _say_survey(survey: Survey) -> None:
    files, times = survey.files, survey.order.times
    counts = span([file.num_particles for file in files])
    say("sequence", f"{len(files)} snapshots, {files[0].path} to {files[-1].path}, {counts} particles each")
    say("times", f"{span(times)}, {survey.order.told}")
    for unread in survey.unread:
        say("unread", f"{unread.why}; frames that need it are left out")
    for sentence in survey.told():
        say("between", sentence)
    say_report(survey.report)
    say_notes(survey.report.notes)


def is_looked(options: Any) -> bool:
    """Whether any option says what the source is to look like."""
    return bool(options.said) or options.transfer is not None or options.exposure != 0


def look(shown: Particles | Volume, options: Any, quantity: str) -> TransferFunction:
    """What particles or a volume look like, by the options, with the extinction of typical columns; and say so.

    Raises `UsageError`: options that the quantity does not suit.
    """
    with wrong_usage():
        made, called = look_of(shown, quantity, options)
    if options.exposure:
        made = scaled(made, 2.0**options.exposure)
    say("colours", f"{called} over {quantity} = {span(made.values)}, extinction {span(made.extinction)} per unit length")
    return made


def say_left_out(made: TransferFunction, shown: Any) -> None:
    """Of an axis of logarithms: which values have none."""
    values = np.asarray(made.values, np.float64)
    if len(values) > 2 and Scale.of(values).name == "log":
        left_out, count = int((np.asarray(shown) <= 0).sum()), int(np.size(shown))
        if left_out and values[0] > 0:
            say("note", f"{left_out:,} of {count:,} values are not positive and look as the lowest; see --norm symlog")


def values_of(shown: Particles | Volume) -> np.ndarray:
    """The values that colours are looked up by."""
    return np.asarray(shown.quantity)[np.asarray(shown.valid)] if isinstance(shown, Particles) else np.asarray(shown.values)


def has_key(options: Any) -> bool:
    """Whether a key is to be drawn: units are of a key."""
    return any(is_given(name, getattr(options, name, None)) for name in ("annotate", *UNITS))


def require_figure(output: Path, suffixes: tuple[str, ...] = FIGURES) -> None:
    """Know before the work that a figure can be drawn and written."""
    require_writable(output, "a figure is written as", suffixes)
    require("matplotlib", "figures", "color")


def labels_of(loaded: Loaded, options: Any) -> Labels | None:
    """Labels by the units that were asked for; None leaves them to the file. In code units, with a note, without unyt.

    Raises `UsageError`: a unit that does not agree, or that is not stated.
    """
    if loaded.table is None:
        refuse(options, UNITS, f"is for files that state units, and {loaded.path} does not; leave it out")
        return Labels(loaded.quantity)
    if not has_key(options):
        return Labels() if hasattr(options, "unit") else None
    table, values = loaded.table, np.asarray(values_of(loaded.shown), np.float64)
    largest = float(np.abs(values).max(initial=0)) if values.size else 1.0
    if loaded.quantity.lower().startswith(LOG_PREFIX) and values.size:
        largest = 10.0 ** float(values.max())
    stated = unit_of(table, loaded.quantity) is not None or table.units.length is not None
    if stated and not can_name() and options.unit is None and options.length_unit is None:
        say("note", f"code units: {NEEDS}")
    with wrong_usage():
        made = io.labels_of(table, loaded.quantity, largest, unit=options.unit, length_unit=options.length_unit)
    return dataclasses.replace(made, opacity=loaded.opacity_by or made.opacity)


def say_units(table: ParticleTable) -> None:
    """Say which units a file states."""
    stated = [*(["positions"] if table.units.length is not None else []), *table.units.columns]
    if stated:
        say("units", f"stated for {', '.join(stated)}")
    if moment := io.labels_of(table, "", 1.0).moment:
        say("time", moment)


def require_key(options: Any, output: Path) -> None:
    """Know before the work that the key can be drawn, where there is one."""
    if has_key(options):
        require_figure(output, (".png",))


def save_with_key(image: Image, scene: Scene, camera: Camera, labels: Labels, options: Any, output: Path) -> None:
    """Write the picture in front of its background, with its key, and what its file says of how it was made."""
    if getattr(options, "background", None) is not None:
        color: Any = image.over(options.background)
        image = dataclasses.replace(image, color=color, transmittance=image.transmittance * 0)
    figure = image_figure(image, scene, camera, labels=labels, target=options.target)
    write_figure(figure, output, metadata={str(name): str(value) for name, value in image.metadata})
