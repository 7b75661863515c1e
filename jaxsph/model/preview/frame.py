r"""Framing by what is seen: the central part of the light of a picture fills most of it, whatever lies far outside.

Flow: Scene, direction -> [frame: Glimpse by Glimpse] -> Camera.

A first camera shows the bulk of the particles. Of a coarse picture (`glimpse`) the box that holds the central 99 % of alpha is
taken; the camera is moved sideways and back such that the box fills 88 % of the picture, and looks again. Where
the light reaches the edge of the picture, it steps back first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.model.camera.camera import Bounded, BoundingBox, Camera, axes_along, require_up
from jaxsph.model.camera.directions import corners_of, filled
from jaxsph.model.camera.framing import clipped, snug_between
from jaxsph.model.particles.particles import Particles
from jaxsph.model.preview.glimpse import extinction_at, glimpse, typical_exposure
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import array_of

CENTRAL = 0.99
FILLED = 0.88
EDGE = 0.04  # of a side: light that comes so near to an edge goes on beyond it
BULK = (0.03, 0.97)  # between which quantiles of volume times extinction, along each direction, the first camera shows particles
STEPS_BACK, LOOKS = 5, 3
STEP_BACK = 1.5
SETTLED = 0.05  # change of the height by which no further look is taken
DENSEST, MIN_CORE, LOST, OF_PICTURE = 0.1, 10, 100.0, 0.35
"""Share of the particles that are the core, and the fewest of them; how many times larger a picture is in which that is lost, and
the part of one that it fills then.
"""
USUAL, STRAY = 98, 30.0
"""Percentile of the distances from the middle, and how many times as far particles lie that are left out of a first picture."""
FLAT, UPRIGHT = 0.25, 0.05  # thickness of what is flat, over its width; and tilts that are none: a slab is seen along its edges
DIM, DEEP = 2e-3, 1.5  # share of the light at either end of the depths, and how much deeper a picture is than all other light
ALL_ALONG = 0.75  # of a side of a period, from which on particles that fill it have no middle there
MARGIN = 1.05  # of a perspective picture of a box over what is in it


@dataclasses.dataclass(frozen=True, eq=False)
class Direction:
    """How a scene is looked at, but for from where and how near.

    Attributes:
        axes: (3, 3), rows right, up and forward.
        fov_degrees: vertical field of view; None is parallel rays.
        size: width and height in pixels.
    """

    axes: Float[np.ndarray, "3 3"]
    fov_degrees: float | None
    size: tuple[int, int]

    @classmethod
    def along(cls, forward: object, up: object, fov_degrees: float | None, size: tuple[int, int]) -> Direction:
        """Of a line of sight and a direction that is upward in the picture.

        Raises `ValueError`: an upward direction that is zero or parallel to the line of sight.
        """
        ahead, upward = (np.asarray(one, np.float64) for one in (forward, up))
        ahead = ahead / np.linalg.norm(ahead)
        require_up(ahead, upward)
        return cls(axes_along(ahead, upward), fov_degrees, size)

    def camera(self, middle: np.ndarray, height: float, shown: Bounded, reach: float = math.inf) -> Camera:
        """The camera that shows so much of the height at `middle`; depths are snug to what is in it, within `reach`."""
        distance = height if self.fov_degrees is None else height / 2 / math.tan(math.radians(self.fov_degrees) / 2)
        make, opening = (Camera.orthographic, height) if self.fov_degrees is None else (Camera.look_at, self.fov_degrees)
        eye = middle - self.axes[2] * distance
        made = make(eye, middle, self.axes[1], opening, *self.size, near=distance / 2, far=2 * distance)
        return snug_in_picture(made, shown, (distance - reach, distance + reach))


def fitted(scene: Scene, direction: Direction, center: np.ndarray | None = None) -> Camera:
    """The camera whose picture the central 99 % of the light of a scene fill to 88 % (host side).

    Args:
        scene: particles and volumes with their looks; where neither is, points or nothing are framed by their bounds.
        direction: of the line of sight.
        center: (3,) what is in the middle of the picture, length units; None leaves it to the light.
    """
    aspect = direction.size[0] / direction.size[1]
    scene = _evenly_lit(scene)
    middle, height, largest = _first(scene, direction, center)
    camera = direction.camera(middle, height, scene)
    for nth in range(STEPS_BACK + LOOKS):
        seen = glimpse(scene, camera)
        weights = seen.weights(typical_exposure(seen))
        alpha = weights.sum(2)
        sides = float(camera.half_height) * np.array([aspect, 1.0])
        light = alpha.any()
        box = np.array([_central(seen.u, alpha.sum(0)), _central(seen.v, alpha.sum(1))]) if light else np.zeros((2, 2))
        beyond = not light or bool((np.abs(box) > (1 - 2 * EDGE) * sides[:, None]).any())
        if beyond and height < largest and nth < STEPS_BACK:
            height = min(height * STEP_BACK, largest)
            camera = direction.camera(middle, height, scene)
            continue
        if not light:
            break
        depth = float((weights * seen.depth).sum() / weights.sum())
        per_unit = depth if camera.is_perspective else 1.0
        if center is None:
            across = box.mean(1) * per_unit
            middle = camera.exact_eye() + across @ direction.axes[:2] + depth * direction.axes[2]
            extent = (box[:, 1] - box[:, 0]) * per_unit
        else:
            extent = 2 * np.abs(box).max(1) * per_unit
        before, height = height, max(float(extent[1]), float(extent[0]) / aspect) / FILLED
        camera = direction.camera(middle, height, scene)
        if abs(height - before) < SETTLED * before:
            break
    core, across = _core(scene) if center is None else (middle, math.inf)
    if LOST * across < height:
        return direction.camera(core, across / OF_PICTURE, scene, across / OF_PICTURE)
    reach = _depth_of_light(scene, direction, middle)
    return direction.camera(middle, height, scene, reach) if math.isfinite(reach) else camera


def _depth_of_light(scene: Scene, direction: Direction, middle: np.ndarray) -> float:
    """How far before and behind the middle there is light, amply: samples along rays are for that, and not for thin gas far away.

    Infinite where there is more than particles.
    """
    if scene.particles is None or len(scene.parts) > 1 or not scene.particles.num_particles:
        return math.inf
    light = scene.particles.unpadded(_strength(scene))
    if not light.any():
        return math.inf
    share, along = light / light.sum(), (scene.particles.places() - middle) @ direction.axes[2]
    margin = float(np.average(scene.particles.unpadded(scene.particles.support), weights=share))
    return DEEP * float(np.abs(_quantiles(along, share, (DIM, 1 - DIM))).max()) + 2 * margin


def _core(scene: Scene) -> tuple[np.ndarray, float]:
    """Where the densest tenth of the particles is, and how large, but for its outermost tenth; of a few as large as can be."""
    if scene.particles is None or scene.particles.num_particles < MIN_CORE / DENSEST:
        return np.zeros(3), math.inf
    volume, position = scene.particles.to_numpy()["volume"], scene.particles.places()
    dense = position[np.argpartition(volume, count := int(DENSEST * len(volume)))[:count]]
    core = np.median(dense, axis=0)
    return core, 2 * float(np.percentile(np.linalg.norm(dense - core, axis=1), 100 * (1 - DENSEST))) or math.inf


def boxed(shown: Bounded, direction: Direction, center: np.ndarray | None = None) -> Camera:
    """The camera whose picture shows all of a box, or so much around a place (host side)."""
    lower, upper = filled(shown.bounds())
    (_, up, forward), size = direction.axes, direction.size
    if center is not None:
        lower, upper = center - (upper - lower) / 2, center + (upper - lower) / 2
    if direction.fov_degrees is None:
        camera = Camera.along_axis(BoundingBox(lower, upper), forward, *size, up=up)
    else:
        how: dict[str, Any] = {"direction": forward, "up": up, "fov_degrees": direction.fov_degrees, "margin": MARGIN}
        camera = Camera.framing(BoundingBox(lower, upper), width=size[0], height=size[1], **how)
    return camera if center is None else snug_in_picture(camera, shown)


def around_all(cameras: Sequence[Camera], center: np.ndarray | None) -> Camera:
    """The camera that shows all that those of one line of sight and opening show, around a center where one is asked for.

    Of parallel rays its picture is the box around theirs; in perspective its eye is so far back that their views are in its own.
    """
    first, axes, ends = cameras[0], np.asarray(cameras[0].axes, np.float64), np.array([one.near_and_far() for one in cameras])
    eyes, half = np.array([one.exact_eye() for one in cameras]) @ axes.T, np.array([[float(one.half_height)] for one in cameras])
    sides = np.array([first.width / first.height, 1.0])
    reach = sides * half * (-eyes[:, 2:] if first.is_perspective else 1)  # of a view in the plane of depth 0, < 0 behind its eye
    low, high = (eyes[:, :2] - reach).min(0), (eyes[:, :2] + reach).max(0)
    middle = (low + high) / 2 if center is None else axes[:2] @ center
    tall = float((np.maximum(high - middle, middle - low) / sides).max())
    back = -tall / half[0, 0] if first.is_perspective else eyes[0, 2]
    eye, depths = np.array([*middle, back]) @ axes, ends + eyes[:, 2:] - back
    how = {"up": axes[1], "width": first.width, "height": first.height, "near": depths.min(), "far": depths.max()}
    if first.is_perspective:
        return Camera.look_at(eye, eye + axes[2], fov_degrees=2 * math.degrees(math.atan(half[0, 0])), **how)
    return Camera.orthographic(eye, eye + axes[2], view_height=2 * tall, **how)


def bulk_of(particles: Particles, amounts: np.ndarray) -> BoundingBox:
    """The box around the central 99 % of amounts that particles have, and around supports there (host side).

    In a period it reaches across faces, too, and has a whole side along axes where the bulk fills more than half of it.
    """
    counted = np.asarray(particles.valid) & (amounts > 0)
    share, ends = amounts[counted] / amounts[counted].sum(), []
    margin = float(np.asarray(particles.support, np.float64)[counted] @ share)
    position = particles.exact_position()[counted]
    for axis, (low, high) in enumerate(zip(*particles.bounds(), strict=True)):
        place, side = position[:, axis], high - low
        if particles.box is not None:
            begin, length = _arc(place, share, side)
            if length > side / 2:
                ends.append((low, high))
                continue
            middle = low + (begin + length / 2 - low) % side
            place = middle + (place - middle + side / 2) % side - side / 2
        first, last = _quantiles(place, share, ((1 - CENTRAL) / 2, (1 + CENTRAL) / 2))
        ends.append((first - margin, last + margin))
    return BoundingBox(*np.array(ends).T)


def bulk_of_period(scene: Scene) -> BoundingBox | None:
    """Around the central 99 % of the light of a periodic set (`bulk_of`). None where it fills the box, or there is no light."""
    scene = _evenly_lit(scene)
    particles = scene.particles
    if particles is None or particles.box is None or not (light := _strength(scene) * np.asarray(particles.valid)).any():
        return None
    lower, upper = particles.box.corners()
    box = bulk_of(particles, light)
    return None if (box.upper - box.lower >= upper - lower).all() else box


def central(particles: Particles, mass: np.ndarray, direction: Direction) -> Camera:
    """The camera whose picture the central 99 % of the mass fill to 88 %; or, of what is a hundred times larger than its dense
    core, the core to a third (host side). Periodic sets are to be in one piece.
    """
    lower, upper = bulk_of(particles, mass).bounds()
    aside = (upper - lower) * (1 / FILLED - 1) / 2
    camera = boxed(BoundingBox(lower - aside, upper + aside), direction)
    core, across = _core(Scene(particles=particles))
    if LOST * across < float((upper - lower).max()):
        return direction.camera(core, across / OF_PICTURE, particles)
    return camera


def across_faces(scene: Scene) -> np.ndarray | None:
    """The middle of a period, (3,), in which the bulk of a periodic set is whole; None where it is so already."""
    bulk, particles = bulk_of_period(scene), scene.particles
    if bulk is None or particles is None or particles.box is None:
        return None
    lower, upper = particles.box.corners()
    beyond = (bulk.lower < lower) | (bulk.upper > upper)
    return np.where(beyond, (bulk.lower + bulk.upper) / 2, (lower + upper) / 2) if beyond.any() else None


def halfway(particles: Particles) -> np.ndarray:
    """The place, (3,), that half of the particles lie on either side of, along each axis, which a few far off do not move.

    Of a periodic set on the circle of each side, cut where they are not; where they lie all along it, its middle (host side).
    """
    position = particles.places()
    if particles.box is None:
        return np.asarray(np.median(position, axis=0))
    place, share = [], np.full(len(position), 1 / len(position))
    for values, low, high in zip(position.T, *particles.box.corners(), strict=True):
        side = high - low
        begin, length = _arc(values, share, side)
        first = begin + (length - side) / 2
        middle = np.median(first + (values - first) % side) if length < ALL_ALONG * side else (low + high) / 2
        place.append(low + (middle - low) % side)
    return np.array(place)


def without_strays(particles: Particles) -> tuple[Particles, int]:
    """Those that lie together, and how many do not: a few particles far away, with supports as long, would be before all others.

    Nothing strays in a period.
    """
    valid = np.asarray(particles.valid)
    if particles.box is not None or not valid.any():
        return particles, 0
    position = particles.exact_position()
    away = np.linalg.norm(position - np.median(position[valid], axis=0), axis=1)
    kept = valid & (away <= STRAY * np.percentile(away[valid], USUAL, method="lower"))
    return dataclasses.replace(particles, valid=array_of(kept)), int(valid.sum() - kept.sum())


def flat_along(scene: Scene) -> np.ndarray | None:
    """The axis along which the inner half of the particles is flat, as of a disc or a plane, (3,); None where it is not."""
    if scene.particles is None or scene.particles.num_particles < MIN_CORE:
        return None
    position = scene.particles.places()
    away = np.linalg.norm(position - np.median(position, axis=0), axis=1)
    variance, axes = np.linalg.eigh(np.cov(position[away <= np.median(away)].T))
    axis = np.where(np.abs(axes[:, 0]) < UPRIGHT, 0.0, axes[:, 0])
    return axis / np.linalg.norm(axis) if np.sqrt(max(variance[0], 0.0)) < FLAT * np.sqrt(max(variance[1], 0.0)) else None


def num_outside(scene: Scene, camera: Camera) -> int:
    """Particles whose middle is not in the picture, or nearer or farther than it shows (host side)."""
    if scene.particles is None:
        return 0
    view = camera.exact_view(scene.particles.places())
    half = float(camera.half_height) * np.array([camera.width / camera.height, 1.0])
    reach, (near, far) = view[:, 2:] * half if camera.is_perspective else half, camera.near_and_far()
    return int(((np.abs(view[:, :2]) > reach).any(1) | (view[:, 2] < near) | (view[:, 2] > far)).sum())


def snug_in_picture(camera: Camera, shown: Bounded, between: tuple[float, float] = (-math.inf, math.inf)) -> Camera:
    """`camera` with near and far moved to what is in its picture, between two depths; unchanged where nothing is (host side).

    Of a scene that is supports and radii that reach into the picture, and whole volumes; of anything else the box around it.
    """
    scene = shown if isinstance(shown, Scene) else Scene()
    half = float(camera.half_height)
    sides = np.array([half * camera.width / camera.height, half])
    ends: list[tuple[float, float]] = []
    for center, radius in _spheres(scene):
        view = camera.exact_view(center)
        front, back = view[:, 2] - radius, view[:, 2] + radius
        reach = np.maximum(back, 0)[:, None] * sides if camera.is_perspective else sides
        wide = np.sqrt(1 + sides**2) if camera.is_perspective else np.ones(2)
        first = max(between[0], 0) if camera.is_perspective else between[0]
        seen = (np.abs(view[:, :2]) <= reach + radius[:, None] * wide).all(1) & (back > first) & (front < between[1])
        if seen.any():
            ends.append((float(front[seen].min()), float(back[seen].max())))
    for box in [volume for volume, _ in scene.volumes] if scene is shown else [shown]:
        depth = (corners_of(*box.bounds()) - camera.exact_eye()) @ camera.exact_axes()[2]
        ends.append((float(depth.min()), float(depth.max())))
    if not ends:
        return camera
    near, far = max(min(front for front, _ in ends), between[0]), min(max(back for _, back in ends), between[1])
    near, far = clipped((near, far), camera, scene.within, *scene.parts)
    return snug_between(camera, near, far) if near < far else camera


def _first(scene: Scene, direction: Direction, center: np.ndarray | None) -> tuple[np.ndarray, float, float]:
    """The middle and height of a first picture, of the bulk of what there is; and the height of all of it."""
    aspect = direction.size[0] / direction.size[1]
    corners = corners_of(*filled(scene.bounds())) @ direction.axes.T
    low, high = corners.min(0), corners.max(0)
    if center is not None:
        reach = np.abs(corners - center @ direction.axes.T).max(0)
        largest = 2 * max(reach[1], reach[0] / aspect) + reach[2]
    else:
        largest = max(high[1] - low[1], (high[0] - low[0]) / aspect) * 2
    if scene.particles is not None and scene.particles.num_particles:
        local = scene.particles.places() @ direction.axes.T
        light = scene.particles.unpadded(_strength(scene))
        share = light / light.sum() if light.any() else np.full(len(light), 1 / len(light))
        margin = float(np.average(scene.particles.unpadded(scene.particles.support), weights=share))
        inner = np.stack([_quantiles(axis, share, BULK) for axis in local.T], 1) + np.array([[-margin], [margin]])
        low, high = np.maximum(low, inner[0]), np.minimum(high, inner[1])
    middle = (low + high) / 2 @ direction.axes if center is None else np.asarray(center, np.float64)
    height = max(high[1] - low[1], (high[0] - low[0]) / aspect)
    return middle, float(min(height, largest)), float(largest)


def _evenly_lit(scene: Scene) -> Scene:
    """A scene whose surface shows all of its particles alike as one of an even fog of them; others as they are."""
    if scene.surface is None or scene.particles is None:
        return scene
    particles = dataclasses.replace(scene.particles, extinction_quantity=None)
    even = TransferFunction.from_points((0.0, 1.0), np.ones((2, 3)), (1.0, 1.0))
    return dataclasses.replace(scene, particles=particles, transfer=even, surface=None)


def _strength(scene: Scene) -> np.ndarray:
    """Volume times extinction of each particle, without regard to what lies in front of it."""
    particles, look = scene.particle_set, scene.transfer
    assert look is not None
    return extinction_at(look, np.asarray(particles.quantities[-1], np.float64)) * np.asarray(particles.volume, np.float64)


def _quantiles(values: np.ndarray, share: np.ndarray, at: tuple[float, float]) -> np.ndarray:
    """Of values that weigh by shares of 1."""
    order = np.argsort(values)
    summed = np.cumsum(share[order]) - share[order] / 2
    return np.interp(at, summed, values[order])


def _arc(values: np.ndarray, share: np.ndarray, side: float) -> tuple[float, float]:
    """Where the shortest part of a circle begins that holds the bulk of values that weigh by shares of 1; and its length."""
    turned = values % side
    order = np.argsort(turned)
    twice = np.concatenate([turned[order], turned[order] + side])
    summed = np.cumsum(np.tile(share[order], 2))
    before = np.append(0, summed[: len(order) - 1])
    last = np.minimum(np.searchsorted(summed, before + BULK[1] - BULK[0]), len(twice) - 1)
    length = twice[last] - twice[: len(order)]
    best = int(np.argmin(length))
    return float(twice[best]), float(length[best])


def _central(places: np.ndarray, light: np.ndarray) -> tuple[float, float]:
    """Between which coordinates the central part of the light is; light is even within a pixel."""
    order = np.argsort(places)
    step = float(abs(places[1] - places[0]))
    edges = np.append(places[order] - step / 2, places[order[-1]] + step / 2)
    share = np.append(0, np.cumsum(light[order])) / light.sum()
    low, high = np.interp([(1 - CENTRAL) / 2, (1 + CENTRAL) / 2], share, edges)
    return float(low), float(high)


def _spheres(scene: Scene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centres and radii of particles and points, without padding; of a periodic set the corners of its box."""
    spheres = [(points.places(), points.unpadded(points.radius)) for points in scene.point_sets]
    particles = scene.particles
    if particles is not None and particles.num_particles:
        if particles.box is not None:
            spheres.append((corners_of(*particles.bounds()), np.zeros(8)))
        spheres.append((particles.places(), particles.unpadded(particles.support)))
    return spheres
