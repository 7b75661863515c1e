"""From where anything is seen: the one place that makes a camera of middle, width and line of sight, the rest by what is there.

Flow: Scene, or what has bounds, View, ParticleTable -> [views] -> Camera, Clip, what was chosen -> opening, commands.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from typing import Any, NamedTuple

import numpy as np

from jaxsph.io.opening.options import View, length_of
from jaxsph.io.settle.around import away_from, centre_of_mass
from jaxsph.io.settle.quantities import velocity_name
from jaxsph.io.table import ParticleTable
from jaxsph.model.camera.camera import Bounded, BoundingBox, Camera, require_fov
from jaxsph.model.camera.directions import UP, VIEWS as ALONG, sight, upright
from jaxsph.model.camera.path import middle
from jaxsph.model.clips import Clip, Sphere, both
from jaxsph.model.particles.flat import dimensions_of
from jaxsph.model.particles.particles import Particles
from jaxsph.model.preview.frame import Direction, boxed, fitted, halfway, num_outside, snug_in_picture
from jaxsph.model.scene import Scene
from jaxsph.numerics.names import did_you_mean
from jaxsph.numerics.trees import fitting

FOV_DEGREES, FRAMED_FOV_DEGREES = 45.0, 30.0
"""Vertical fields of view of an eye that is placed, and of one that is found: the farther away, the less near things loom."""
REACH = 0.75  # of the larger side of the picture, how far from its middle things are shown: its corners are at 0.71
OBLIQUE_UP = 0.1  # cosine to what is up, from which on one looks from above
OBLIQUE = 0.9  # cosine to z, from which on a line is seen along y
PERIODS, ROUNDING = 1024, 1e-6  # how far off clips are looked for; and of a side, by which what fits into it may be longer
TURNED = "face-on", "edge-on"  # views that are by how particles turn
Said = list[tuple[str, str]]


class Framed(NamedTuple):
    """How a scene is seen.

    Attributes:
        camera, clip: from where, and what is shown of it.
        said: what was chosen, for people: pairs of a word and a sentence.
        center: (3,) what is in the middle of the picture, where that, a width or an eye was asked for.
        up: (3,) which way is up.
    """

    camera: Camera
    clip: Clip | None
    said: Said
    center: np.ndarray | None = None
    up: Any = UP


def framed(
    shown: Bounded,
    view: View,
    table: ParticleTable | None = None,
    *,
    whole: bool = False,
    known_up: tuple[Any, str] | None = None,
    strays: int = 0,
) -> Framed:
    """How what is there is seen.

    Args:
        shown: a scene with its looks, of which what is lit is framed; or what has bounds, of which all is.
        view: what is asked for.
        table: of its particles, for masses, velocities, units and what is up.
        whole: all of a scene is framed, too, where no width is asked for, and nothing of it is left out.
        strays: particles that were left out of it before, as they lie far from all others.
        known_up: what is up in files of this kind, and which kind; that of the table, if not given.

    Raises `ValueError`: a center where nothing is, no length, what the particles do not hold, clips that leave nothing.
    """
    clip, lit = clip_of(view), None
    left = left_by(clip, shown)
    if isinstance(shown, Scene) and not (whole and clip is not None):
        left = scene = dataclasses.replace(shown, within=both(shown.within, clip))
        lit = None if whole else scene
    said: Said = []
    known_up = (table.up, table.source) if table is not None else known_up
    upward, _ = (view.up, "") if view.up is not None else known_up or (UP, "")
    if view.up is None and known_up is not None:
        z = f"z, as in others of {known_up[1]}, or as most lies low; --up 0,1,0 has y"
        said.append(("up", "y; --up 0,0,1 has z" if tuple(known_up[0]) == UP else z))
    if view.eye is not None:
        return _from_eye(left, view, upward, clip, said)
    center = place_of(shown, view.center, table)
    if center is not None:
        said.append(("center", written_place(center)))
    direction = direction_of(view, upward, table, center)
    if center is None and lit is None and clip is None and not view.frame_all:
        is_whole = view.width is None and view.view not in TURNED
        center = amid(shown, direction.axes[2] if is_whole else None)
    if view.frame_all:
        center = np.mean(left.bounds(), 0) if center is None else center
        return Framed(_all_of(left, direction, center), clip, said, center, upward)
    if view.width is None:
        camera = boxed(left, direction, center) if lit is None else fitted(lit, direction, center)
        if lit is not None and clip is None and (outside := num_outside(lit, camera) + strays):
            count = lit.particle_set.num_particles + strays
            said.append(("frame", f"{outside:,} of {count:,} particles lie outside of the picture; --width all shows them"))
        return Framed(camera, clip, said, center, upward)
    width, told = length_of(view.width, "width", None if table is None else table.units.length)
    if center is None:
        center = np.mean(left.bounds(), 0) if lit is None else np.array(middle(fitted(lit, direction)))
    said.append(("width", f"{width:.6g}" + (f" ({told}{frame_told(table)})" if told else "")))
    height, reach = width * view.size[1] / view.size[0], math.inf
    if view.clips is None and lit is not None:
        reach = REACH * max(width, height)
        clip = Sphere(tuple(center), reach, of_width=True)
        said.append(("clip", f"what is farther than {reach:.4g} from the middle is left out; --clip none shows it"))
    return Framed(direction.camera(center, height, left, reach), clip, said, center, upward)


def frame_told(table: ParticleTable | None) -> str:
    """In which frame lengths with a unit are, where there is more than one."""
    if table is None or table.units.length is None or table.units.redshift is None:
        return ""
    left = table.units.length.a or table.units.length.h
    return ", comoving, as the file has it: --physical takes a and h out" if left else ", physical"


def fitted_camera(scene: Scene, size: tuple[int, int], *, across: Any = None, **view: Any) -> Camera:
    """See `Camera.fitted`: the camera of `framed`, which leaves nothing of the scene out."""
    known = {"center", "view", "up", "fov_degrees", "frame_all"}
    if not known >= set(view):
        wrong, there = min(set(view) - known), ["across", *sorted(known)]
        raise ValueError(f"`Camera.fitted` has no option {wrong!r}; there are {', '.join(there)}{did_you_mean(wrong, there)}")
    if fitting("scene", scene, Scene).parts:
        scene.check()
    return framed(scene, View(size=size, width=across, clips=(), **view)).camera


def clip_of(view: View) -> Clip | None:
    """What is in all clips that are asked for; None where there are none."""
    return functools.reduce(operator.and_, view.clips) if view.clips else None


def left_by(clip: Clip | None, shown: Bounded) -> Bounded:
    """What there is to frame: all of it, or the box of what a clip leaves. Raises `ValueError`: that is nothing."""
    if clip is None:
        return shown
    lower, upper = shown.bounds()
    low, high = np.array([clip.ends(axis, lower, upper) for axis in np.eye(3)]).T
    if not (low < high).all():
        raise ValueError(f"nothing is inside of `clips`; there is something {ends_of(lower, upper)}")
    return BoundingBox(low, high)


def amid(shown: Bounded, along: np.ndarray | None = None) -> np.ndarray | None:
    """The place, (3,), that half of the particles lie on either side of (`halfway`); None where there are no particles.

    With a direction `along`, the middle of the box around them instead, moved along that direction to this place's depth.
    """
    particles = shown.particles if isinstance(shown, Scene) else None
    if particles is None or not particles.num_particles:
        return None
    place = halfway(particles)
    if along is None:
        return place
    box = np.mean(shown.bounds(), 0)
    return np.asarray(box + (place - box) @ along * along)


def in_period(
    shown: Scene, view: View, table: ParticleTable | None, low: Any = (-np.inf,) * 3, high: Any = (np.inf,) * 3
) -> tuple[Particles, View]:
    """A periodic set with its period around what is to be in the middle of a view, then around its clips, and around what lies
    from `low` to `high`, (3,), as far as these are over a face and no longer than a side; and the view, with its center in there.
    """
    particles: Any = shown.particles
    place = place_of(shown, view.center, table)
    if place is not None:
        particles = particles.centered(place)
    lower, upper = particles.box.corners()
    side, clip = upper - lower, clip_of(view)
    far = PERIODS * side
    clipped = [(-np.inf, np.inf)] * 3 if clip is None else [clip.ends(axis, lower - far, upper + far) for axis in np.eye(3)]
    for first, last in (np.transpose(clipped), (np.asarray(low), np.asarray(high))):
        lower, upper = particles.box.corners()
        slack = ROUNDING * side
        over = ((first < lower - slack) | (last > upper + slack)) & (first <= last) & (last - first <= side + slack)
        if over.any():
            middle = (np.where(over, first, lower) + np.where(over, last, upper)) / 2
            particles = particles.centered(middle)
    if place is not None:
        lower = particles.box.corners()[0]
        view = dataclasses.replace(view, center=tuple((lower + (place - lower) % side).tolist()))
    return particles, view


def flat_on(view: View, position: np.ndarray, box: Any, up: Any) -> tuple[View, Said]:
    """Turn a view that nobody chose to where a plane or a line of particles is seen as a whole; return what to say of it, too."""
    if view.view is not None or view.eye is not None or view.fov_degrees is not None:
        return view, []
    along_z = getattr(view, "along_z", False)  # of columns and planes, where nothing lies in another plane
    dimensions, axes = dimensions_of(position, box)
    if dimensions == 3:
        return (dataclasses.replace(view, view="z") if along_z else view), []
    axis = axes[0] if dimensions == 2 else np.eye(3)[2 if abs(axes[2, 2]) < OBLIQUE else 1]
    largest = int(np.abs(axis).argmax())
    seen: Any = "xyz"[largest] if abs(axis[largest]) == 1 else toward(axis, view.up if view.up is not None else up)
    lies, called = ("in a plane", "on a line")[dimensions == 1], seen if isinstance(seen, str) else written_place(seen)
    said = [] if along_z and seen == "z" else [("view", f"along {called}, as all particles lie {lies}")]
    return dataclasses.replace(view, view=seen), said


def places_of(particles: Particles) -> tuple[np.ndarray, Any]:
    """Positions of all that exist, and the sides of their period, if any."""
    box = particles.box
    return particles.places(), None if box is None else np.subtract(*box.corners()[::-1])


def toward(axis: np.ndarray, up: Any) -> tuple[float, ...]:
    """An axis or its opposite: from above, or if it lies level from where the largest coordinate points to."""
    upward = float(axis @ np.asarray(up, np.float64))
    return tuple((axis * (np.sign(upward) if abs(upward) > OBLIQUE_UP else np.sign(axis[np.abs(axis).argmax()]))).tolist())


def written_place(place: Any) -> str:
    """Coordinates as text."""
    return " ".join(f"{value:.6g}" for value in place)


def ends_of(lower: np.ndarray, upper: np.ndarray) -> str:
    """From where to where a box is, in words."""
    return f"from {written_place(lower)} to {written_place(upper)}"


def direction_of(view: View, upward: Any, table: ParticleTable | None, center: np.ndarray | None = None) -> Direction:
    """The line of sight that is asked for, with what is up."""
    if view.view in (None, "iso"):
        fov = FRAMED_FOV_DEGREES if view.fov_degrees is None else view.fov_degrees
        require_fov(fov)
        return Direction.along(*sight("iso", upward), fov, view.size)
    if not isinstance(view.view, str):
        forward = -np.asarray(view.view, np.float64)
        return Direction.along(forward, upright(forward, upward), None, view.size)
    if view.view in ALONG:
        return Direction.along(*sight(view.view, upward), None, view.size)
    spin = angular_momentum(table, center, view.view)
    across = np.cross(spin, UP if abs(spin[1]) < 0.9 * np.linalg.norm(spin) else (1.0, 0.0, 0.0))
    forward, own = (-spin, np.cross(across, spin)) if view.view == "face-on" else (across, spin)
    return Direction.along(forward, own if view.up is None else view.up, None, view.size)


def sighted(table: ParticleTable, camera: Camera, from_eye: bool, particles: Particles) -> ParticleTable:
    """A table whose vectors have a component along the line of sight: along each ray from the eye to where its particles are in
    the period of those that are shown, or along the middle one.
    """
    sight = (camera.exact_eye(), True) if from_eye else (camera.exact_axes()[2], False)
    return dataclasses.replace(table, sight=sight if particles.box is None else (*sight, particles.box.corners()[0]))


def angular_momentum(table: ParticleTable | None, center: np.ndarray | None, view: str) -> np.ndarray:
    """The direction about which particles turn, (3,): the sum of m (x - c) x (v - <v>) over the nearest half.

    Raises `ValueError`: particles without velocities, or that do not turn.
    """
    name = None if table is None else velocity_name(table)
    if table is None or name is None:
        raise ValueError(f"`view` = {view!r} needs velocities, and there are none; choose x, y, z or iso")
    mass, offset = masses_of(table), away_from(table, centre_of_mass(table) if center is None else center)
    away = np.linalg.norm(offset, axis=1)
    near = away <= np.median(away)
    velocity = table.exact(name)[near]
    moving = velocity - np.average(velocity, axis=0, weights=mass[near])
    spin = (mass[near, None] * np.cross(offset[near], moving)).sum(0)
    if not np.linalg.norm(spin) > 0:
        why = "needs particles that turn, and their angular momentum is zero"
        raise ValueError(f"`view` = {view!r} {why}; choose x, y, z or iso")
    return np.asarray(spin / np.linalg.norm(spin))


def place_of(shown: Bounded, center: Any, table: ParticleTable | None) -> np.ndarray | None:
    """The middle of the picture, (3,), where it is asked for."""
    if center is None:
        return None
    scene = shown if isinstance(shown, Scene) else Scene()
    if not isinstance(center, str):
        place, (lower, upper) = np.asarray(center, np.float64), shown.bounds()
        periodic = scene.particles is not None and scene.particles.box is not None  # every place is inside of that
        if not periodic and ((place < lower).any() or (place > upper).any()):
            raise ValueError(f"`center` = {written_place(place)} is outside of everything: that lies {ends_of(lower, upper)}")
        return place
    if scene.particles is None or not scene.particles.num_particles:
        raise ValueError(f"`center` = {center!r} needs particles; give x, y and z")
    if center == "densest":
        return scene.particles.densest()
    if table is None:
        raise ValueError("`center` = 'mass' needs the masses of a file; give x, y and z")
    return centre_of_mass(table)


def masses_of(table: ParticleTable) -> np.ndarray:
    """Return the mass of each particle, 1 where the file has none."""
    mass = table.masses()
    return np.ones(len(table)) if mass is None else mass


def _from_eye(shown: Bounded, view: View, upward: Any, clip: Clip | None, said: Said) -> Framed:
    """From the eye that is asked for, snug to what is in its picture; what it looks at is in the middle."""
    place = place_of(shown, view.center, None)
    target = place if view.target is None else view.target
    if view.target is not None and place is not None and getattr(getattr(shown, "particles", shown), "box", None) is None:
        raise ValueError("`center` and `target` exclude each other: without a period both are what is in the middle")
    if target is None:
        target = np.mean(shown.bounds(), 0)
    fov = FOV_DEGREES if view.fov_degrees is None else view.fov_degrees
    up = upright(np.subtract(target, view.eye), upward) if view.up is None else upward  # type: ignore[arg-type]
    camera = snug_in_picture(Camera.look_at(view.eye, target, up, fov, *view.size, near=1e-3, far=1.0), shown)
    return Framed(camera, clip, said, np.asarray(target, np.float64), upward)


def _all_of(shown: Bounded, direction: Direction, center: np.ndarray) -> Camera:
    """A camera that shows every support."""
    lower, upper = shown.bounds()
    reach = float(np.linalg.norm(np.maximum(np.abs(lower - center), np.abs(upper - center)))) or 0.5
    width, height = direction.size
    half = math.radians(direction.fov_degrees or 0) / 2
    return direction.camera(center, 2 * reach * max(1, height / width) / math.cos(half), shown)
