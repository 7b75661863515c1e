"""How flat pictures of a file are seen, columns and planes: along an axis, around what a periodic set has in the middle, by mass.

Flow: options, particles -> [flat] -> columns, planes.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxsph import io
from jaxsph.cli import figures, scene as cli_scene
from jaxsph.cli.console import UsageError, wrong_usage
from jaxsph.cli.voice import say_all
from jaxsph.io import Labels
from jaxsph.io.images.planes import SUFFIXES
from jaxsph.io.opening import values
from jaxsph.io.opening.opened import Loaded, Opened, is_free
from jaxsph.io.opening.views import (
    TURNED,
    Framed,
    amid,
    clip_of,
    direction_of,
    framed,
    in_period,
    left_by,
    masses_of,
)
from jaxsph.io.settle.assemble import chosen
from jaxsph.model.camera.directions import VIEWS
from jaxsph.model.preview.frame import bulk_of, central, num_outside
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import array_of

MOST_OF_PICTURE = 0.75  # of the height of a picture of all: what fills more is shown with all
WRITTEN = (*SUFFIXES, *figures.VECTORS)


def along_a_line(options: Any) -> Any:
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


def opened_flat(options: Any, loaded: Loaded, like: Opened | None, transfer: TransferFunction | None = None) -> Opened:
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
        ends = [plane.point] * 2 if plane else depths_of(options)
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


def depths_of(options: Any) -> Any:
    """From where to where, (2, 3), a depth range along an axis is."""
    ends = np.array([[-np.inf] * 3, [np.inf] * 3])
    if getattr(options, "depth_range", None) is not None and options.view in VIEWS:
        ends[:, "xyz".index(options.view)] = np.sort(options.depth_range)
    return ends
