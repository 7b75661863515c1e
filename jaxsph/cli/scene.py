"""What a command shows: its scene, from files and names, and the camera that looks at it.

Flow: options -> [cli_scene] -> Scene, Camera -> cli.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from typing import Any

from jaxsph import io, scenes
from jaxsph.cli import annotate as cli_annotate
from jaxsph.cli import particles as cli_particles
from jaxsph.cli import points as cli_points
from jaxsph.cli import transfer as cli_transfer
from jaxsph.cli import volume as cli_volume
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, say, span
from jaxsph.model import Camera, Particles, Scene
from jaxsph.model.camera.camera import Bounded
from jaxsph.scenes.view import snug, snug_box

SCENE = "scene:"


def scene_of(options: argparse.Namespace) -> tuple[Scene, Camera]:
    """The source, and what else shares its picture; a camera that frames all of it unless one is asked for."""
    scene, shown, camera = source_of(options)
    if options.command == "sweep":
        return scene, camera or camera_of(shown, options)
    volumes, points = cli_volume.beside(options), cli_points.points_of(options)
    if volumes or points or options.mix:
        scene = cli_points.with_parts(scene, volumes, [one for _, one in points], options.mix)
    if not volumes and not points:
        return scene, camera or camera_of(shown, options)
    named = [] if shown is None else [(options.source, shown)]
    paths = [(path, volume) for path, (volume, _) in zip(options.volume or (), volumes, strict=True)]
    parts = cli_points.Together([*named, *paths, *points])
    cli_points.warn(parts, options.command)
    return scene, camera_of(parts, options)


def source_of(options: argparse.Namespace) -> tuple[Any, Any, Camera | None]:
    """Scene of the source, what there is to frame, and the camera where it has one."""
    if options.source is None:
        of_source = ("quantity", "opacity_by", "support", "kernel", "part_type", "iso", "particles", "frame")
        refuse(
            options, (*of_source, *cli_transfer.LOOKS, *cli_where.OF_PARTICLES), "is for FILE or scene:NAME, and there is none"
        )
        return None, None, None
    if options.source.startswith(SCENE):
        scene, camera = _scene_of_name(options)
        return scene, scene.particle_set, camera
    return *_scene_of_file(options), None


def require_something(options: argparse.Namespace, also: str = "") -> None:
    """Raise `UsageError` where there is nothing to show."""
    cli_points.check_usage(options)
    if options.source is None and not options.points and not options.volume:
        raise UsageError(f"a particle file, a volume or scene:NAME is needed as FILE, or --points FILE, or --volume FILE{also}")


def _scene_of_name(options: argparse.Namespace) -> tuple[Scene, Camera]:
    of_files = ("quantity", "opacity_by", "support", "kernel", "part_type", "iso", *cli_where.OF_FILES)
    refuse(options, of_files, "is for particle files, not for built-in scenes")
    name = options.source.removeprefix(SCENE)
    width, height = getattr(options, "size", (512, 512))
    try:
        scene, camera = scenes.load(name, options.particles, options.frame, width=width, height=height)
    except ValueError as error:
        raise UsageError(str(error)) from error
    particles = scene.particle_set
    say("scene", f"{name}, {particles.num_particles:,} particles, support {span(particles.to_numpy()['support'])}")
    if options.command != "info":
        if cli_transfer.asked(options):
            scene = dataclasses.replace(scene, transfer=cli_transfer.look(particles, options, "concentration"))
        cli_annotate.label("concentration", options, "a built-in scene")
        if any(getattr(options, part) is not None for part in ("eye", "target", "up", "fov")):
            camera = camera_of(particles, options)
    return scene, camera


def _scene_of_file(options: argparse.Namespace) -> tuple[Scene, Bounded]:
    refuse(options, ("particles", "frame"), "is for built-in scenes, not for files")
    if io.is_volume(options.source):
        of_particles = ("opacity_by", "support", "kernel", "part_type", *cli_where.OF_PARTICLES)
        refuse(options, of_particles, "is for particles, and this is a volume")
        return cli_volume.scene_of(options)
    refuse(options, ("iso",), "is for volumes, and this is a particle file")
    return cli_particles.scene_of(options)


def camera_of(shown: Bounded, options: argparse.Namespace) -> Camera:
    """The camera asked for; where only a part is given, the rest frames what there is."""
    shown = cli_where.framed(shown, options)
    width, height = options.size
    up, fov = options.up or (0.0, 1.0, 0.0), 45.0 if options.fov is None else options.fov
    if options.target is not None and options.eye is None:
        raise UsageError("--target needs --eye: from where should it be looked at?")
    try:
        if options.eye is None:
            return Camera.framing(shown, up=up, fov_degrees=fov, width=width, height=height)
        lower, upper = shown.bounds()
        target = (lower + upper) / 2 if options.target is None else options.target
        made = Camera.look_at(options.eye, target, up, fov, width, height, near=1e-3, far=1.0)
        return snug(made, shown) if isinstance(shown, Particles) else snug_box(made, lower, upper)
    except ValueError as error:
        raise UsageError(str(error)) from error


def described(options: argparse.Namespace) -> tuple[Bounded, Camera | None]:
    """Say what the source holds; what there is to frame, and its camera where it has one."""
    if options.source.startswith(SCENE):
        scene, camera = _scene_of_name(options)
        say("quantity", f"concentration, {span(scene.particle_set.to_numpy()['quantity'])}")
        return scene.particle_set, camera
    refuse(options, ("particles", "frame"), "is for built-in scenes, not for files")
    if io.is_volume(options.source):
        return cli_volume.describe(options.source, options.quantity), None
    return cli_particles.describe(options), None


def refuse(options: argparse.Namespace, names: Sequence[str], why: str) -> None:
    """Raise `UsageError` where an option is given that is for something else."""
    for name in names:
        if getattr(options, name, None) is not None:
            raise UsageError(f"--{name.replace('_', '-')} {why}")
