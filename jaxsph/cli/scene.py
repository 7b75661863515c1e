"""What a command shows: its scene, from files and names, what it looks like, and the camera that looks at it.

Flow: options -> [scene] -> `jaxsph.io.opening` -> Scene, Camera, Labels -> commands; survey -> Snapshots -> movie, view.

A file is opened as `jaxsph.io.read_scene` opens it, bit for bit. A built-in scene comes with its own look and camera. Volumes and
points may share a picture. A sequence of files has one look, said on the way.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph import io, scenes
from jaxsph.cli import console, figures
from jaxsph.cli.console import SCENE, UsageError, progress, refuse, say_notes, say_report, span, wrong_usage
from jaxsph.cli.voice import report, result, say, say_all, tell
from jaxsph.engine.media.surfaces.iso_surface import IsoSurface
from jaxsph.io import Labels
from jaxsph.io.opening.looks import look_of, surface_of, told_of_surface, values_of
from jaxsph.io.opening.opened import Loaded, Opened, exposed, labels_of, load, staged
from jaxsph.io.opening.options import OF_SURFACE, Look, Source
from jaxsph.io.opening.values import colormap, read_as, with_options
from jaxsph.io.opening.views import TURNED, clip_of, direction_of, framed, left_by, place_of, written_place
from jaxsph.io.settle.assemble import AUTO
from jaxsph.io.settle.quantities import unit_of
from jaxsph.io.units import NEEDS, can_name, moment_of, spoken, stated_length, written
from jaxsph.io.volumes.volume_files import nothing_there
from jaxsph.model.camera.camera import Bounded, BoundingBox, Camera
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import Points
from jaxsph.model.preview.frame import across_faces, bulk_of_period
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import Scale
from jaxsph.model.volume import Volume
from jaxsph.sequence.snapshots import Snapshots, center_of
from jaxsph.sequence.survey import Survey, surveyed, table_of

ISO_COLOR = 0.85, 0.8, 0.7
SAME_TIME = 1e-3  # by which scale factors and redshifts of a file may differ, as they are rounded
OF_SCENES = {"particles": read_as("a whole number of particles", int), "frame": read_as("a number as frame", float)}
"""What stands behind the name of a built-in scene."""
PLACED = ("center", "width", "view", "eye", "target", "up", "fov_degrees", "frame_all")  # options that place a camera


def require_something(options: Any) -> None:
    """Raise `UsageError` where there is nothing to show."""
    if options.source is None and not options.points and not options.volume:
        raise UsageError("a particle file, a volume or scene:NAME is needed as FILE, or --points FILE, or --volume FILE")


def opened_of(options: Any, like: Opened | None = None) -> Opened:
    """The source, and what else shares its picture; its camera, labels and what was chosen, said; as another is, if any."""
    volumes, points = volumes_of(options), points_of(options)
    parts: list[tuple[str, Any]] = [*((path, volume) for path, volume, _ in volumes), *points]
    beside = Scene(
        volume=tuple(volume for _, volume, _ in volumes) or None,
        volume_transfer=tuple(look for *_, look in volumes) or None,
        points=tuple(made for _, made in points) or None,
        mix=getattr(options, "mix", None) or Scene().mix,
    )
    if all_parts := bool(parts) and not is_placed(options):
        options = dataclasses.replace(options, frame_all=True)
    shown: list[tuple[str, Bounded]] = []
    if options.source is None:
        with wrong_usage():
            seen = framed(beside, options)
        scene = dataclasses.replace(beside, within=seen.clip)
        opened = Opened(scene, seen.camera, Labels(), (), seen.center, seen.up)
    else:
        opened, part = _source(options, beside, like)
        shown = [(options.source, part)]
    for sentence in apart([*shown, *parts]):
        tell(options.command, f"warning: {sentence}")
    report(particles=opened.scene.particle_set.num_particles if opened.scene.particles is not None else 0)
    return dataclasses.replace(opened, center=None) if all_parts else opened


def is_placed(options: Any) -> bool:
    """Whether any option says where the camera is."""
    return any(getattr(options, name, None) not in (None, False) for name in PLACED)


def named_scene(options: Any) -> tuple[Loaded, Scene, Camera]:
    """Particles of the built-in scene of `scene:NAME:particles=N,frame=K`, said; it in its own look, and its camera."""
    refuse(options, options.of_particles + ("iso", "color_by", "surface_of"), "is for particle files, not for built-in scenes")
    width, height = getattr(options, "size", (512, 512))
    try:
        asked = with_options(OF_SCENES)(options.source)
        name, behind = asked.file.removeprefix(SCENE), asked.options
        made, camera = scenes.load(name, behind.get("particles"), behind.get("frame"), width=width, height=height)
    except ValueError as error:
        raise UsageError(str(error).replace("`frame`", "frame of scene:NAME")) from error
    particles = made.particle_set
    say("scene", f"{name}, {particles.num_particles:,} particles, support {span(particles.to_numpy()['support'])}")
    return Loaded(options.source, particles, "concentration"), made, camera


def _source(options: Any, beside: Scene, like: Opened | None) -> tuple[Opened, Particles | Volume]:
    """A file, as `io.read_scene` opens it; or a built-in scene, in its own look and by its own camera where none is asked for."""
    if like is not None:
        first, key = like.scene, like.labels
        given: dict[str, Any] = dict.fromkeys(("colormap", "norm", "range", "preset", "optical_depth"))
        given |= {"transfer": (first.looks or (None,))[0], "exposure": 0.0, "surface": first.surface or False}
        given |= {} if first.within is None else {"clips": (first.within,)}
        if first.particles is not None and not options.source.startswith(SCENE):
            box = first.particle_set.box
            given |= {} if box is None else {"center": tuple(np.mean(box.corners(), 0).tolist())}
            given |= {"color_by": key.quantity, "opacity_by": None if key.opacity == Labels.opacity else key.opacity}
        options = dataclasses.replace(options, **given)
    loaded, own, camera = loaded_of(options)
    look = options
    if is_own := own is not None and not is_looked(options):
        given = {one: getattr(options, one, None) for one in ("surface", *OF_SURFACE)}
        look = Look(transfer=own.transfer, **given)  # type: ignore[union-attr]
    labels, camera = key_of(loaded, options), like.camera if like is not None else None if is_placed(options) else camera
    with wrong_usage():
        opened = staged(loaded, look, options, source=options, beside=beside, labels=labels, camera=camera)
    say_all((what, text) for what, text in opened.said if not is_own or what != "colours")
    if (table := loaded.table) is not None:
        opened = dataclasses.replace(opened, measures=(written(unit_of(table, loaded.quantity)), written(table.units.length)))
    if getattr(options, "iso", None) is not None:
        assert isinstance(loaded.shown, Volume)
        color = ISO_COLOR if options.colormap is None else tuple(scenes.colormap(options.colormap)[-1])
        say("surface", f"where the values are {options.iso:g}")
        surface = IsoSurface.from_volume(loaded.shown, options.iso, color)  # seen from where the volume would be
        opened = dataclasses.replace(opened, scene=dataclasses.replace(beside, media=(surface,), within=opened.scene.within))
    elif not is_own:
        say_left_out(opened.scene.looks[0], values_of(loaded.shown))
    return opened, loaded.shown


def loaded_of(options: Any, *, joined: bool = False) -> tuple[Loaded, Scene | None, Camera | None]:
    """What the source gives to a picture, said; its look and camera if it is built in. `joined` types are one set."""
    if options.source.startswith(SCENE):
        return named_scene(options)
    if io.is_volume(options.source):
        refuse(options, (*options.of_particles, "surface", "surface_of", *OF_SURFACE), "is for particles, and this is a volume")
        volume, name = volume_of_file(options.source, options.color_by)
        return Loaded(str(options.source), volume, name), None, None
    refuse(options, ("iso",), "is for volumes, and this is a particle file")
    with wrong_usage(of=io.ConditionError):
        loaded = load(options.source, options, options, None if options.command == "movie" else options, joined=joined)
    if joined:
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
    return loaded, None, None


def say_chosen(loaded: Loaded, known: Collection[str] = ()) -> None:
    """Say what was chosen of the particles of a file, but for notes that are `known`."""
    taken: Any = loaded.report
    columns = loaded.shown.to_numpy()  # type: ignore[union-attr]
    say_report(taken, columns["support"], known)
    stated = None if loaded.table is None else unit_of(loaded.table, loaded.quantity)
    unit = "" if stated is None else spoken(stated)
    say("quantity", f"{loaded.quantity}, {figures.ends_said(columns['quantity'], Labels(loaded.quantity), unit, None)[1]}")
    if loaded.opacity_by is not None:
        say("opacity", f"by {loaded.opacity_by}, {span(columns.get('extinction_quantity', columns['quantity']))}")


def snapshots_of(options: Any, *, gaps: bool, strict: bool) -> tuple[Snapshots, Opened, Bounded]:
    """The snapshots and their look, as said on the way; that in the middle and how all are seen, and what there ever is."""
    for path in options.source:
        if path.startswith(SCENE) or (Path(path).exists() and io.is_volume(path)):
            raise UsageError(f"a sequence is one of particle files, but there is {path}; give it alone")
    refuse(options, ("iso", "volume", "points", "mix"), "is not for a sequence of particle files")
    if options.center == "mass":
        raise UsageError("--center mass is for one file; of a sequence give X,Y,Z or densest")
    if len(options.types) > 1:
        raise UsageError(f"--part-type must be one type of particles for a sequence, got {options.part_type!r}; choose one")
    options = _in_colours_of_type(options)
    by = options.surface_of or options.opacity_by or (None if options.transfer is not None else AUTO)
    survey = _surveyed(options, by, gaps, strict)
    _say_survey(survey)
    looks = options if options.transfer is not None else dataclasses.replace(options, range=options.range or survey.span)
    with wrong_usage():
        surface = surface_of(survey.middle, survey.report, options, options, clipped=bool(options.clips))
    colored = survey.middle if surface is None else dataclasses.replace(survey.middle, extinction_quantity=None)
    transfer = look(colored, looks, survey.quantity)
    of_range = "as asked for" if options.range else f"nearly all values of all {len(survey.files)} snapshots"
    say("", f"for all frames; range: {of_range}; extinction: by the picture of {survey.report.path}")
    middle, center, free = Scene(particles=survey.middle, transfer=transfer), None, options.eye is None and not options.clips
    with wrong_usage():
        if survey.box is not None:
            center = center_of(survey, options.center)
        elif options.center is not None:
            options = dataclasses.replace(options, center=tuple(place_of(middle, options.center, None)))  # type: ignore[arg-type]
    asked = None if options.target is not None else center  # in the middle of the picture, beside that of the period
    if center is None and free and (place := across_faces(middle)) is not None:
        center = tuple(place.tolist())
        say("box", f"its middle is {written_place(center)}, as what is shown lies across its faces")
    if surface is not None:
        say("surface", f"{told_of_surface(surface, options)}; all frames alike, by {survey.report.path}")
    with wrong_usage():
        snapshots = Snapshots(survey, transfer, center, clip_of(options), surface)
        if center is not None:
            middle = dataclasses.replace(middle, particles=survey.middle.centered(center))
            options = dataclasses.replace(options, center=asked)
        shown: Bounded = snapshots
        if free and (bulk := bulk_of_period(middle)) is not None:
            each = (bulk_of_period(snapshots.at(snapshots.times[nth])) or snapshots for nth in (0, -1))
            part = BoundingBox.around((bulk, *each))
            if asked is None or ((part.lower <= asked) & (asked <= part.upper)).all():
                shown = part
                say("frame", "nearly all of the first, middle and last snapshot; --width all shows the rest")
        whole = surface is not None or center is not None or options.width or options.frame_all  # spray is seen
        if free and not whole and (bulk := survey.bulk()) is not None:
            shown = bulk
            say("frame", "nearly all particles of all snapshots; --width all shows the rest")
        options = _turned(options, survey, center)
        seen = framed(shown, options, known_up=(survey.report.up, survey.report.source))
        say_all(seen.said)
        whole = left_by(snapshots.within, shown)
    middle = dataclasses.replace(middle, within=snapshots.within)
    if surface is None:
        middle = exposed(middle, seen.camera, options)
        snapshots = dataclasses.replace(snapshots, transfer=middle.looks[0])
    return snapshots, Opened(middle, seen.camera, Labels(), (), seen.center, seen.up), whole


def _surveyed(options: Any, opacity_by: str | None, gaps: bool, strict: bool) -> Survey:
    """What all files of a sequence hold."""
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(Source)}
    with progress("read", " files") as show, wrong_usage(of=io.ConditionError):
        try:
            source = Source(**given | {"opacity_by": opacity_by})
            return surveyed(options.source, source, gaps=gaps, strict=strict, progress=show)
        except ValueError as error:
            if "missing" in str(error) and not gaps:
                raise ValueError(f"{error}; --gaps goes on without") from error
            raise


def _in_colours_of_type(options: Any) -> Any:
    """Options with the colours that the only type of particles is given, if it is."""
    if len(options.types) != 1 or (kind := options.types[0])[1] is None:
        return options
    with wrong_usage():
        own = options.colormap or (options.transfer is None and colormap(kind[1])) or None
    return dataclasses.replace(options, part_type=kind[0], colormap=own)


def _turned(options: Any, survey: Survey, center: Any) -> Any:
    """Options with one direction for all frames, where that is by how particles turn: those of the first snapshot; said."""
    if options.view not in TURNED:
        return options
    first = survey.files[0].path
    table = table_of(survey.source, first)
    if center is not None and survey.box is not None:  # in one piece
        lower = np.asarray(center) - np.asarray(survey.box) / 2
        table = dataclasses.replace(table, position=lower + np.mod(table.position - lower, survey.box))
    axes = direction_of(options, survey.report.up, table, options.center if center is None else np.asarray(center)).axes
    say("view", f"{options.view} in {first}, from {written_place(-axes[2])} in all frames")
    return dataclasses.replace(options, view=tuple((-axes[2]).tolist()), up=tuple(axes[1].tolist()))


def labels_of_sequence(snapshots: Snapshots, options: Any) -> Callable[[float | None], Labels]:
    """What is shown, at a time of a sequence; redshifts where times are scale factors, as those of comoving runs are."""
    survey = snapshots.survey
    if not figures.has_key(options):
        return lambda time: Labels()
    table = io.read_table(survey.report.path, part_type=options.types[0][0], physical=options.physical)
    shown = Loaded(survey.report.path, survey.middle, survey.quantity, survey.report.opacity_by, table)
    labels = key_of(shown, options) or Labels()
    units, redshift = table.units, table.units.redshift
    comoving = redshift is not None and table.time is not None and abs(table.time * (1 + redshift) - 1) < SAME_TIME

    def at(time: float | None) -> Labels:
        if time is None or not survey.order.by_files:  # numbers in names are no times
            return dataclasses.replace(labels, moment="")
        told: dict[str, Any] = {"time": None, "redshift": 1 / time - 1} if comoving else {"time": time, "redshift": None}
        return dataclasses.replace(labels, moment=moment_of(dataclasses.replace(units, **told)))

    return at


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


def is_looked(options: Any) -> bool:
    """Whether any option says what the source is to look like."""
    return bool(options.said) or options.transfer is not None or options.exposure != 0


def look(shown: Particles | Volume, options: Any, quantity: str) -> TransferFunction:
    """What particles or a volume look like, by options that suit, with the extinction of typical columns; colours are said."""
    with wrong_usage():
        made, called = look_of(shown, quantity, options)
    say("colours", f"{called} over {quantity} = {span(made.values)}")
    return made


def say_left_out(made: TransferFunction, shown: Any) -> None:
    """Of an axis of logarithms: which values have none."""
    values, left_out = np.asarray(made.values, np.float64), int((np.asarray(shown) <= 0).sum())
    if left_out and values[0] > 0 and len(values) > 2 and Scale.of(values).name == "log":
        say("note", f"{left_out:,} of {np.size(shown):,} values are not positive and look as the lowest; see --norm symlog")


def key_of(loaded: Loaded, options: Any) -> Labels | None:
    """Labels by units that are asked for, which must agree; None leaves them to the file. Without unyt code units, and a note."""
    table = loaded.table
    if table is None:
        refuse(options, figures.UNITS, f"is for files that state units, and {loaded.path} does not; leave it out")
        return Labels(loaded.quantity)
    if not hasattr(options, "unit") or not figures.has_key(options):
        return Labels(loaded.quantity) if hasattr(options, "unit") else None
    stated = unit_of(table, loaded.quantity) is not None or table.units.length is not None
    if stated and not can_name() and options.unit is None and options.length_unit is None:
        say("note", f"code units: {NEEDS}")
    with wrong_usage():
        return labels_of(loaded, options.unit, options.length_unit)


def apart(parts: Sequence[tuple[str, Bounded]]) -> list[str]:
    """A sentence for each two named parts whose boxes are farther apart than either is large: their units may differ."""
    boxes = [(name, *part.bounds()) for name, part in parts]
    said = []
    for one, other in itertools.combinations([box for box in boxes if (box[2] > box[1]).any()], 2):
        gap = float(np.linalg.norm(np.maximum(np.maximum(one[1] - other[2], other[1] - one[2]), 0)))
        if gap > max(float(np.linalg.norm(upper - lower)) for _, lower, upper in (one, other)):
            where = " and ".join(
                f"{name} in " + " x ".join(f"[{low:.4g}, {high:.4g}]" for low, high in zip(lower, upper, strict=True))
                for name, lower, upper in (one, other)
            )
            said.append(f"{where} lie {gap:.4g} apart: are they in the same units?")
    return said


def volumes_of(options: Any) -> list[tuple[str, Volume, TransferFunction]]:
    """The volumes of every `--volume`, each with its file and what it looks like."""
    made = []
    for beside in getattr(options, "volume", ()):
        volume, _ = volume_of_file(beside.file, beside.options.get("quantity"))
        name = beside.options.get("colormap", "viridis")
        look = scenes.default_transfer(volume, name)
        say("colours", f"{name} over {span(look.values)}, extinction {span(look.extinction)} per unit length")
        made.append((beside.file, volume, look))
    return made


def volume_of_file(path: str, quantity: str | None, *, described: bool = False) -> tuple[Volume, str]:
    """A volume, and the name of its values; `described` says all that the file holds."""
    table = io.read_volume_table(path)
    what = f"{path}: {table.source}, {' x '.join(map(str, table.shape))} points"
    if not described:
        say("file", what)
        volume, name = io.volume_from_table(table, quantity)
        say("quantity", f"{name}, {volume.values.dtype}, {console.ranges(np.asarray(volume.values).ravel())}")
        say_notes((*table.conventions, *filter(None, [nothing_there(volume)])))
        return volume, name
    rows = [
        f"  {one}  {' x '.join(map(str, values.shape))}  {values.dtype}  {console.ranges(values.reshape(-1, *values.shape[3:]))}"
        for one, values in table.arrays.items()
    ]
    where = f"lower corner {written_place(table.lower)}, spacing {written_place(table.spacing)}"
    result("\n".join([what, *(f"  {sentence}" for sentence in table.conventions), "", *rows, "", where]))
    result("\n`jaxsph render` would show")
    report(shape=table.shape, lower=table.lower, spacing=table.spacing, values=list(table.arrays))
    volume, name = io.volume_from_table(table, quantity)
    say("quantity", name)
    return volume, name


def points_of(options: Any, *, described: bool = False) -> list[tuple[str, Points]]:
    """The points of every `--points`, by file; `described` says all that the files hold."""
    made = []
    for beside in getattr(options, "points", ()):
        table = io.read_table(beside.file, part_type=beside.options.get("type"))
        what = f"{beside.file}: {table.source}, {len(table):,} points"
        if described:
            result(what)
            console.attributes(table)
            result("\n`jaxsph render` would show as points")
        else:
            say("points", what)
        given = {name: value for name, value in beside.options.items() if name != "type"}
        points, taken = io.points_from_table(table, **{"colormap": "heat"} | given)
        say("radius", f"{span(taken.radius_range if taken.num_points else ())}: {taken.radius}")
        say("colours", taken.color)
        say("strength", f"{span(taken.strength_range if taken.num_points else ())}: {taken.strength}")
        say_notes(taken.notes)
        made.append((beside.file, points))
    return made
