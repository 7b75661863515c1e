"""From where a scene is seen: middle, width and line of sight as asked for, the rest by what is lit.

Flow: Scene, View, ParticleTable -> [views] -> Camera, Clip, what was chosen.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
import re
from typing import Any, NamedTuple

import numpy as np
import scipy.spatial

from jaxsph.io.opening.options import View
from jaxsph.io.settle.quantities import ROLES, velocity_name
from jaxsph.io.table import CodeUnit, ParticleTable
from jaxsph.io.units import named
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import UP, sight, upright
from jaxsph.model.camera.framing import VIEWS as ALONG
from jaxsph.model.camera.path import middle
from jaxsph.model.clips import Clip, Sphere, both
from jaxsph.model.preview.frame import Direction, fitted, num_outside, snug_in_picture
from jaxsph.model.scene import Scene

FOV_DEGREES, FRAMED_FOV_DEGREES = 45.0, 30.0
"""Vertical fields of view of an eye that is placed, and of one that is found: the farther away, the less near things loom."""
REACH = 0.75  # of the larger side of the picture, how far from its middle things are shown: its corners are at 0.71
NEIGHBOURS = 32  # particles within the distance by which the densest place is told
MEASURE = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")

Said = list[tuple[str, str]]


def length_of(value: Any, name: str, unit: CodeUnit | None) -> tuple[float, str | None]:
    """A length, > 0, in the unit that a file states for its own, if it does, and how its own unit was understood.

    Raises:
        ValueError: no positive length; a unit that is not one of length, or where the file does not state its own.
    """
    found = MEASURE.fullmatch(value) if isinstance(value, str) else None
    if isinstance(value, str) and found is None:
        raise ValueError(f"`{name}` must be a length, such as 30 or '30 kpc', got {value!r}")
    number, wanted = (float(found[1]), found[2]) if found else (float(value), "")
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"`{name}` must be > 0 and finite, got {value!r}")
    if not wanted:
        return number, None
    if unit is None:
        raise ValueError(f"`{name}` = {value!r} has a unit, but the file does not state that of its lengths: give a number")
    try:
        factor, called = named(unit, 1.0, wanted)
    except ValueError as error:
        raise ValueError(f"`{name}` = {value!r} is no length: {error}") from error
    return number / factor, f"{number:g} {called}"


class Framed(NamedTuple):
    """How a scene is seen.

    Attributes:
        camera, clip: from where, and what is shown of it.
        said: what was chosen.
        center: (3,) what is in the middle of the picture, where that or a width was asked for.
    """

    camera: Camera
    clip: Clip | None
    said: Said
    center: np.ndarray | None = None


def framed(scene: Scene, view: View, table: ParticleTable | None = None) -> Framed:
    """How a scene with its looks is seen; the table of its particles is for masses, velocities, units and what is up.

    Raises:
        ValueError: a center where there is nothing, a length that is none, what the particles do not hold.
    """
    clip = functools.reduce(operator.and_, view.clips) if view.clips else None
    shown = dataclasses.replace(scene, within=both(scene.within, clip))
    if view.eye is not None:
        return Framed(_from_eye(shown, view, table), clip, [])
    said: Said = []
    center = place_of(scene, view.center, table)
    if view.center is not None:
        said.append(("center", " ".join(f"{value:.6g}" for value in center)))  # type: ignore[union-attr]
    direction = direction_of(view, table, center)
    if view.frame_all:
        return Framed(_all_of(shown, direction, center), clip, said, center)
    if view.width is None:
        camera = fitted(shown, direction, center)
        outside = num_outside(scene, camera)
        if outside and clip is None:
            count = scene.particle_set.num_particles
            said.append(("frame", f"{outside:,} of {count:,} particles lie outside of the picture; --width all shows them"))
        return Framed(camera, clip, said, center)
    width, told = length_of(view.width, "width", None if table is None else table.units.length)
    if center is None:
        center = np.array(middle(fitted(shown, direction)))
    said.append(("width", f"{width:.6g}" + (f" ({told})" if told else "")))
    height = width * view.size[1] / view.size[0]
    reach = math.inf
    if view.clips is None:
        reach = REACH * max(width, height)
        clip = Sphere(tuple(center), reach)
        said.append(("clip", f"what is farther than {reach:.4g} from the middle is left out; --clip none shows it"))
    return Framed(direction.camera(center, height, shown, reach), clip, said, center)


def fitted_camera(scene: Scene, size: tuple[int, int], *, across: Any = None, **view: Any) -> Camera:
    """See `Camera.fitted`: the camera of `framed`, which leaves nothing of the scene out."""
    known = {"center", "view", "up", "fov_degrees", "frame_all"}
    if not known >= set(view):
        raise ValueError(
            f"`Camera.fitted` has no option {min(set(view) - known)!r}; there are across, {', '.join(sorted(known))}"
        )
    if scene.parts:
        scene.check()
    return framed(scene, View(size=size, width=across, clips=(), **view)).camera


def told_of_up(up: Any, source: str) -> str:
    """Which way is up in files of this kind, and how it is said otherwise."""
    return "y; --up 0,0,1 has z" if up == UP else f"z, as in other files like this ({source}); --up 0,1,0 has y"


def direction_of(view: View, table: ParticleTable | None = None, center: np.ndarray | None = None) -> Direction:
    """The line of sight that is asked for."""
    upward: Any = view.up if view.up is not None else UP if table is None else table.up
    if view.view in ALONG:
        return Direction.along(*sight(view.view, upward), None, view.size)
    if view.view in ("face-on", "edge-on"):
        spin = angular_momentum(table, center, view.view)
        across = np.cross(spin, UP if abs(spin[1]) < 0.9 * np.linalg.norm(spin) else (1.0, 0.0, 0.0))
        forward, upward = (-spin, np.cross(across, spin)) if view.view == "face-on" else (across, spin)
        return Direction.along(forward, upward if view.up is None else view.up, None, view.size)
    fov = FRAMED_FOV_DEGREES if view.fov_degrees is None else view.fov_degrees
    if not 0 < fov < 180:
        raise ValueError(f"`fov_degrees` must lie in (0, 180), got {fov:g}; it is the vertical field of view")
    return Direction.along(*sight("iso", upward), fov, view.size)


def angular_momentum(table: ParticleTable | None, center: np.ndarray | None, view: str) -> np.ndarray:
    """The direction about which particles turn, (3,): the sum of m (x - c) x (v - <v>) over the nearest half.

    Raises:
        ValueError: particles without velocities, or that do not turn.
    """
    name = None if table is None else velocity_name(table)
    if table is None or name is None:
        raise ValueError(f"`view` = {view!r} needs velocities, and there are none; choose x, y, z or iso")
    mass, position = _masses(table), table.position.astype(np.float64)
    middle = np.average(position, axis=0, weights=mass) if center is None else center
    away = np.linalg.norm(position - middle, axis=1)
    near = away <= np.median(away)
    velocity = table.columns[name].astype(np.float64)[near]
    moving = velocity - np.average(velocity, axis=0, weights=mass[near])
    spin = (mass[near, None] * np.cross(position[near] - middle, moving)).sum(0)
    if not np.linalg.norm(spin) > 0:
        raise ValueError(
            f"`view` = {view!r} needs particles that turn, and their angular momentum is zero; choose x, y, z or iso"
        )
    return np.asarray(spin / np.linalg.norm(spin))


def place_of(scene: Scene, center: Any, table: ParticleTable | None) -> np.ndarray | None:
    """The middle of the picture, (3,), where it is asked for."""
    if center is None:
        return None
    lower, upper = scene.bounds()
    if not isinstance(center, str):
        place = np.asarray(center, np.float64)
        periodic = scene.particles is not None and scene.particles.box is not None  # every place is inside of that
        if not periodic and ((place < lower).any() or (place > upper).any()):
            ends = " to ".join(" ".join(f"{value:.6g}" for value in end) for end in (lower, upper))
            raise ValueError(f"`center` = {' '.join(f'{v:g}' for v in place)} is outside of everything: that lies from {ends}")
        return place
    if scene.particles is None or not scene.particles.num_particles:
        raise ValueError(f"`center` = {center!r} needs particles; give x, y and z")
    if center == "densest":
        return densest(scene)
    if table is None:
        raise ValueError("`center` = 'mass' needs the masses of a file; give x, y and z")
    mass, position = _masses(table), table.position.astype(np.float64)
    if table.box_size is None:
        return np.average(position, axis=0, weights=mass)
    turn = np.exp(2j * np.pi * position / table.box_size)  # mean on circles (Bai & Breen 2008)
    angle = np.angle(np.average(turn, axis=0, weights=mass)) % (2 * np.pi)
    return angle / (2 * np.pi) * np.asarray(table.box_size)


def densest(scene: Scene) -> np.ndarray:
    """The place around which most particles lie for its volume, (3,): that of the smallest mean support of nearby particles."""
    particles = scene.particle_set
    valid = np.asarray(particles.valid)
    position, support = particles.exact_position()[valid], np.asarray(particles.support, np.float64)[valid]
    tree = scipy.spatial.KDTree(position)
    distance, _ = tree.query(position, k=min(NEIGHBOURS, len(position)), workers=-1)
    nearest = np.atleast_2d(distance.T).T[:, -1]
    return np.asarray(position[int(np.argmin(np.where(nearest > 0, nearest, support)))])


def _masses(table: ParticleTable) -> np.ndarray:
    name = table.named(*ROLES["mass"])
    return np.ones(len(table)) if name is None else table.columns[name].astype(np.float64)


def _from_eye(scene: Scene, view: View, table: ParticleTable | None) -> Camera:
    """The camera at the eye that is asked for, snug to what is in its picture."""
    lower, upper = scene.bounds()
    target = (lower + upper) / 2 if view.target is None and view.center is None else view.target
    if target is None:
        target = place_of(scene, view.center, None)
    width, height = view.size
    fov = FOV_DEGREES if view.fov_degrees is None else view.fov_degrees
    found = upright(np.subtract(target, view.eye), UP if table is None else table.up)  # type: ignore[arg-type]
    up = tuple(found) if view.up is None else view.up
    made = Camera.look_at(view.eye, target, up, fov, width, height, near=1e-3, far=1.0)
    return snug_in_picture(made, scene)


def _all_of(scene: Scene, direction: Direction, center: np.ndarray | None) -> Camera:
    """A camera that shows every support."""
    lower, upper = scene.bounds()
    middle = (lower + upper) / 2 if center is None else center
    reach = float(np.linalg.norm(np.maximum(np.abs(lower - middle), np.abs(upper - middle)))) or 0.5
    width, height = direction.size
    half = math.radians(direction.fov_degrees or 0) / 2
    return direction.camera(middle, 2 * reach * max(1, height / width) / math.cos(half), scene)
