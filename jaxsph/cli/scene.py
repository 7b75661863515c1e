"""What a command shows: its scene, from files and names, and the camera that looks at it.

Flow: options -> [cli_scene] -> Scene, Camera, Labels -> cli.
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxsph import io, scenes
from jaxsph.cli import look as cli_look
from jaxsph.cli import parts as cli_parts
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, attributes, refuse, say, say_notes, say_report, span, wrong_usage
from jaxsph.cli.options import SCENE, require_support
from jaxsph.engine.media.iso_surface import IsoSurface
from jaxsph.io import Labels
from jaxsph.model import Camera, Particles, Scene
from jaxsph.model.camera.camera import Bounded, BoundingBox
from jaxsph.model.camera.snug import snug, snug_box

COORDINATES = "x", "y", "z"
ISO_COLOR = 0.85, 0.8, 0.7
OF_PARTICLES = "opacity_by", "support", "kernel", "part_type"
OF_SCENES = "particles", "frame"


class Source(NamedTuple):
    """What a file or a built-in scene gives to a picture.

    Attributes:
        scene: of it alone.
        shown: what there is to frame.
        labels: of its quantity.
        camera: of a built-in scene, its own.
    """

    scene: Scene
    shown: Bounded
    labels: Labels
    camera: Camera | None = None


def require_something(options: argparse.Namespace, also: str = "") -> None:
    """Raise `UsageError` where there is nothing to show."""
    cli_parts.check(options)
    if options.source is None and not options.points and not options.volume:
        raise UsageError(f"a particle file, a volume or scene:NAME is needed as FILE, or --points FILE, or --volume FILE{also}")


def scene_of(options: argparse.Namespace) -> tuple[Scene, Camera, Labels]:
    """The source, and what else shares its picture; a camera that frames all of it unless one is asked for; and its labels."""
    source = source_of(options) if options.source is not None else _no_source(options)
    volumes, points, mix = cli_parts.volumes_of(options), cli_parts.points_of(options), getattr(options, "mix", None)
    scene, camera = source.scene, source.camera
    if volumes or points or mix:
        looks = (*scene.volumes, *((volume, look) for _, volume, look in volumes))
        scene = dataclasses.replace(
            scene,
            volume=tuple(volume for volume, _ in looks) or None,
            volume_transfer=tuple(look for _, look in looks) or None,
            points=(*scene.point_sets, *(made for _, made in points)) or None,
            mix=mix or scene.mix,
        )
    if not volumes and not points:
        return scene, camera or camera_of(source.shown, options), source.labels
    parts = [(options.source, source.shown), *((path, volume) for path, volume, _ in volumes), *points]
    cli_parts.warn_apart(parts, options.command)
    return scene, camera_of(BoundingBox.around(part for _, part in parts), options), source.labels


def source_of(options: argparse.Namespace) -> Source:
    """What the source gives, which is there."""
    if options.source.startswith(SCENE):
        return _scene_of_name(options)
    return _volume(options) if _is_volume(options) else _particles(options)


def _no_source(options: argparse.Namespace) -> Source:
    """Nothing, where parts stand for it."""
    of_source = ("quantity", *OF_PARTICLES, "iso", *OF_SCENES, *cli_look.LOOKS, *cli_where.OF_PARTICLES)
    refuse(options, of_source, "is for FILE or scene:NAME, and there is none")
    return Source(Scene(), BoundingBox.around(()), Labels())


def _is_volume(options: argparse.Namespace) -> bool:
    """Whether the source is a file of a volume; options that are not for a file of its kind are refused."""
    refuse(options, OF_SCENES, "is for built-in scenes, not for files")
    if io.is_volume(options.source):
        refuse(options, (*OF_PARTICLES, *cli_where.OF_PARTICLES), "is for particles, and this is a volume")
        return True
    refuse(options, ("iso",), "is for volumes, and this is a particle file")
    return False


def _scene_of_name(options: argparse.Namespace) -> Source:
    of_files = ("quantity", *OF_PARTICLES, "iso", *cli_where.OF_FILES)
    refuse(options, of_files, "is for particle files, not for built-in scenes")
    name, labels = options.source.removeprefix(SCENE), Labels()
    width, height = getattr(options, "size", (512, 512))
    with wrong_usage():
        scene, camera = scenes.load(name, options.particles, options.frame, width=width, height=height)
    particles = scene.particle_set
    say("scene", f"{name}, {particles.num_particles:,} particles, support {span(particles.to_numpy()['support'])}")
    if options.command != "info":
        if cli_look.asked(options):
            scene = dataclasses.replace(scene, transfer=cli_look.look(particles, options, "concentration"))
        labels = cli_look.label("concentration", options, "a built-in scene")
        if any(getattr(options, part) is not None for part in ("eye", "target", "up", "fov")):
            camera = camera_of(particles, options)
    return Source(scene, particles, labels, camera)


def _volume(options: argparse.Namespace) -> Source:
    """The volume of the source under a colour map, or its iso-surface."""
    volume, name = cli_parts.volume_of_file(options.source, options.quantity)
    labels = cli_look.label(name, options, "a volume")
    if options.iso is None:
        scene = Scene(volume=volume, volume_transfer=cli_look.look(volume, options, name))
    else:
        color = ISO_COLOR if options.colormap is None else tuple(scenes.colormap(options.colormap)[-1])
        say("surface", f"where the values are {options.iso:g}")
        scene = Scene(media=(IsoSurface.from_volume(volume, options.iso, color),))
    return Source(scene, volume, labels)


def _particles(options: argparse.Namespace) -> Source:
    """The particles of the source under a colour map."""
    require_support(options)
    table = io.read_table(options.source, part_type=options.part_type)
    say("file", f"{options.source}: {table.source}, {len(table):,} particles")
    particles, report = _chosen(table, options)
    columns = particles.to_numpy()
    say_report(report, columns["support"])
    _say_quantities(report, columns)
    say_notes(report.notes)
    labels = cli_look.label_file(table, report.quantity, columns["quantity"], options, report.opacity_by)
    particles = cli_where.centered(particles, options)
    look = cli_look.look(particles, options, report.quantity, ramp_of(report))
    return Source(Scene(particles=particles, transfer=look), particles, labels)


def described(options: argparse.Namespace) -> tuple[Bounded, Camera | None]:
    """Say what the source holds; what there is to frame, and its camera where it has one."""
    if options.source.startswith(SCENE):
        source = _scene_of_name(options)
        say("quantity", f"concentration, {span(source.scene.particle_set.to_numpy()['quantity'])}")
        return source.shown, source.camera
    refuse(options, OF_SCENES, "is for built-in scenes, not for files")
    if io.is_volume(options.source):
        return cli_parts.described_volume(options.source, options.quantity), None
    table = io.read_table(options.source, part_type=options.part_type)
    print(f"{options.source}: {table.source}, {len(table):,} particles")
    attributes(table)
    cli_look.say_units(table)
    print("\n`jaxsph render` would show")
    particles, report = _chosen(table, options)
    columns = particles.to_numpy()
    _say_quantities(report, columns)
    say_report(report, columns["support"])
    say_notes(note for note in report.notes if note not in table.conventions)
    return particles, None


def _chosen(table: io.ParticleTable, options: argparse.Namespace) -> tuple[Particles, io.Report]:
    """The particles that are asked for."""
    more = {"opacity_by": opacity_by(options), **cli_where.selected(options)}
    with wrong_usage(of=io.ConditionError):
        return io.particles_from_table(table, options.quantity, options.support, options.kernel, **more)


def opacity_by(options: argparse.Namespace) -> str | None:
    """What opacity is looked up by: nothing of its own where the whole transfer function is said."""
    if options.opacity_by is not None:
        return str(options.opacity_by)
    said = any(getattr(options, name, None) is not None for name in ("transfer", "preset", "domain"))
    return None if said else "auto"


def ramp_of(report: io.Report) -> str | None:
    """How extinction depends on its quantity by default, see `scenes.default_transfer`."""
    return "steep" if report.opacity_by is not None else "even" if report.quantity in COORDINATES else None


def _say_quantities(report: io.Report, columns: dict[str, np.ndarray]) -> None:
    say("quantity", f"{report.quantity}, {span(columns['quantity'])}")
    if report.opacity_by is not None:
        say("opacity", f"by {report.opacity_by}, {span(columns.get('extinction_quantity', columns['quantity']))}")


def camera_of(shown: Bounded, options: argparse.Namespace, depths: tuple[float, float] | None = None) -> Camera:
    """The camera asked for; where only a part is given, the rest frames what there is. Between `depths`, or snug."""
    shown = cli_where.framed(shown, options)
    width, height = options.size
    more: dict[str, Any] = {"up": options.up or (0.0, 1.0, 0.0), "fov_degrees": 45.0 if options.fov is None else options.fov}
    if options.target is not None and options.eye is None:
        raise UsageError("--target needs --eye: from where should it be looked at?")
    with wrong_usage():
        if options.eye is None:
            return Camera.framing(shown, **more, width=width, height=height)
        lower, upper = shown.bounds()
        target = (lower + upper) / 2 if options.target is None else options.target
        near, far = depths or (1e-3, 1.0)
        made = Camera.look_at(options.eye, target, **more, width=width, height=height, near=near, far=far)
        if depths is not None:
            return made
        return snug(made, shown) if isinstance(shown, Particles) else snug_box(made, lower, upper)
