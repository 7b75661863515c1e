"""Where cameras look that are placed by a word, where they stand to show a box, and depths snug to what there is.

Flow: word, upward direction -> [framing] -> Direction; box around particles -> Camera; camera, scene -> Camera with depths.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import OBLIQUE, BoundingBox, Camera, axes_along, require_fov, require_size, require_up
from jaxsph.numerics.checks import array_of, is_traced, one_number, vector_of

VIEWS = {"x": ((-1, 0, 0), (0, 0, 1)), "y": ((0, 1, 0), (0, 0, 1)), "z": ((0, 0, -1), (0, 1, 0))}
"""Line of sight and upward direction: images show y and z, x and z, x and y, the first to the right and the second upwards."""
UP = (0.0, 1.0, 0.0)  # unless anything says otherwise
ALONG = 1e-9  # sine of the angle by which a line of sight is along what is up
NEAREST = 1e-3  # smallest near over far, where particles reach the eye: sample depths are geometric between them
ROUNDING = 1e-4  # relative widening of the depths, far above the rounding of float32 positions
OF_NOTHING = 1.0, 2.0  # depths where nothing is in front of the eye: rays meet nothing between any


def sight(view: str, up: Any = UP) -> tuple[np.ndarray, np.ndarray]:
    """Line of sight and upward direction of `"iso"`, obliquely from above, and of `"x"`, `"y"` and `"z"`, never from below.

    What is up in the world is so in the picture.
    """
    axis = np.asarray(up, np.float64)
    size = np.linalg.norm(axis) or 1.0
    if view == "iso":  # turned as y is turned to what is up (Rodrigues)
        forward, turn, cosine = np.array(OBLIQUE), np.cross(UP, axis / size), axis[1] / size
        if cosine < ALONG - 1:
            return -forward, axis
        return forward + np.cross(turn, forward) + np.cross(turn, np.cross(turn, forward)) / (1 + cosine), axis
    forward = np.asarray(VIEWS[view][0], np.float64)
    forward = -forward if forward @ axis > ALONG * size else forward
    return forward, upright(forward, axis)


def upright(forward: Any, up: Any) -> np.ndarray:
    """What is up in a picture: what is so in the world, or along that such that x is to the right, else y."""
    ahead, axis = (np.asarray(one, np.float64) for one in (forward, up))
    if np.linalg.norm(np.cross(ahead, axis)) > ALONG * np.linalg.norm(ahead) * np.linalg.norm(axis):
        return axis
    across = np.cross((1.0, 0.0, 0.0), ahead)
    return across if across.any() else np.array(UP)


def filled(bounds: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """A box; around what has no extent the unit box."""
    lower, upper = bounds
    return (lower, upper) if (upper > lower).any() else (lower - 0.5, upper + 0.5)


def perspective_view(
    bounds: tuple[np.ndarray, np.ndarray], width: int, height: int, *, direction: Any, up: Any, fov_degrees: float, margin: float
) -> Camera:
    """See `Camera.framing`."""
    require_size(width, height)
    lower, upper = filled(bounds)
    direction, up = vector_of("direction", direction), vector_of("up", up)
    if not direction.any():
        raise ValueError("`direction` must not be 0, 0, 0: it is the line of sight; give x, y and z")
    middle, forward = (lower + upper) / 2, direction / np.linalg.norm(direction)
    require_up(forward, up)
    require_fov(fov_degrees)
    local = (corners_of(lower, upper) - middle) @ axes_along(forward, np.asarray(up, np.float64)).T
    half = math.tan(math.radians(fov_degrees) / 2)
    reach = np.maximum(np.abs(local[:, 0]) * height / width, np.abs(local[:, 1])) * margin / half
    distance = float((reach - local[:, 2]).max())
    near, far = distance + local[:, 2].min(), distance + local[:, 2].max()
    near = max(float(near), NEAREST * float(far))
    eye = middle - forward * distance
    return Camera.look_at(eye, middle, up, fov_degrees, width, height, near=near * 0.999, far=float(far) * 1.001)


def parallel_view(
    bounds: tuple[np.ndarray, np.ndarray],
    width: int,
    height: int,
    *,
    axis: Any,
    up: Any,
    margin: float = 1.0,
    depth_range: Any = None,
) -> Camera:
    """See `Camera.along_axis`; or along any line of sight of length 1."""
    if isinstance(axis, str) and axis not in VIEWS:
        raise ValueError(f"`axis` must be 'x', 'y' or 'z', got {axis!r}")
    require_size(width, height)
    up = up if up is None else vector_of("up", up)
    along = (axis, up) if not isinstance(axis, str) else VIEWS[axis] if up is None else sight(axis, up)
    forward, up = (np.asarray(direction, np.float64) for direction in along)
    right, up, _ = axes_along(forward, up)
    lower, upper = filled(bounds)
    middle, extent = (lower + upper) / 2, upper - lower
    across, deep = float(extent @ np.abs(right)), float(extent @ np.abs(forward))
    view_height = max(float(extent @ np.abs(up)), across * height / width) * margin or 1.0
    distance = deep or 1.0
    near, far = 0.5 * distance - ROUNDING * deep, 1.5 * distance + ROUNDING * deep
    eye = middle - forward * distance
    if depth_range is not None:
        if np.shape(depth_range) != (2,):
            raise ValueError(f"`depth_range` must be two finite coordinates that ascend, got {depth_range!r:.60}")
        begin, end = (one_number("depth_range", one) for one in depth_range)
        if not (np.isfinite(begin) and np.isfinite(end) and begin < end):
            raise ValueError(f"`depth_range` must be two finite coordinates that ascend, got {(begin, end)}")
        near, far = sorted(float((one - eye["xyz".index(axis)]) * forward.sum()) for one in (begin, end))
    return Camera.orthographic(eye, middle, up, view_height, width, height, near=near, far=far)


def with_depths(camera: Camera, shown: Any) -> Camera:
    """With near and far of what is shown, where they are None (host side): those found for a scene's picture, or all of a part.

    Raises `ValueError`: none under a trace, or with media, which do not say how large they are; one that leaves nothing to be
    shown.
    """
    camera = camera.for_picture() if hasattr(shown, "parts") else dataclasses.replace(camera, snug=None)
    if camera.near is not None and camera.far is not None:
        return camera
    traced = is_traced(camera, shown)  # type: ignore[unreachable]
    if traced or getattr(shown, "media", ()):
        where = f"{'under jit, vmap or grad' if traced else 'with `media`'}, where the size of a scene is not known"
        raise ValueError(f"`near` and `far` must be given {where}; give them to the camera")
    parts = getattr(shown, "parts", (shown,))
    found = snug(dataclasses.replace(camera, near=OF_NOTHING[0], far=OF_NOTHING[1]), *parts, clip=getattr(shown, "within", None))
    ends = (camera.near, found.near), (camera.far, found.far)
    near, far = (array_of(own if given is None else given, camera.dtype) for given, own in ends)
    if not float(near) < float(far):
        given = f"`near` = {float(near):.6g} and `far` = {float(far):.6g}"
        raise ValueError(f"{given} hold nothing of the scene; give both, near < far")
    return dataclasses.replace(camera, near=near, far=far)


def snug(camera: Camera, *parts: Any, clip: Any = None) -> Camera:
    """`camera` with near and far moved to what parts reach, as far as a clip shows it; as it is where none is before the eye."""
    spans = [span for part in parts if (span := _span(camera, part)) is not None]
    if not spans:
        return camera
    ends = min(near for near, _ in spans), max(far for _, far in spans)
    return snug_between(camera, *clipped(ends, camera, clip, *parts))


def clipped(ends: tuple[float, float], camera: Camera, clip: Any, *parts: Any) -> tuple[float, float]:
    """Depths at which a clip shows what lies between two; these where it is None, or shows nothing there."""
    if clip is None:
        return ends
    shown = clip.ends(camera.exact_axes()[2], *BoundingBox.around(parts))
    origin = float(_depth(camera, np.zeros(3)))
    near, far = max(ends[0], shown[0] + origin), min(ends[1], shown[1] + origin)
    return (near, far) if near < far else ends


def _span(camera: Camera, part: Any) -> tuple[float, float] | None:
    """From the least to the greatest depth of a part; None of an empty one."""
    if not hasattr(part, "valid") or getattr(part, "box", None) is not None:
        depth = _depth(camera, corners_of(*part.bounds()))
        return float(depth.min()), float(depth.max())
    if not len(part):
        return None
    depth = _depth(camera, part.places())
    reach = part.unpadded(part.support if hasattr(part, "support") else part.radius)
    return float((depth - reach).min()), float((depth + reach).max())


def corners_of(lower: Any, upper: Any) -> np.ndarray:
    """Of a box, the last coordinate first."""
    return np.array(list(itertools.product(*zip(lower, upper, strict=True))))


def _depth(camera: Camera, position: np.ndarray) -> np.ndarray:
    return np.asarray((position - camera.exact_eye()) @ camera.exact_axes()[2])


def snug_between(camera: Camera, near: float, far: float) -> Camera:
    """`camera` with depths about these, none of them behind an eye; as it is where all are (host side)."""
    if camera.is_perspective:
        if far <= 0:
            return camera
        near = max(near, NEAREST * far)
    margin = ROUNDING * max(abs(near), abs(far))
    near = near * (1 - ROUNDING) if camera.is_perspective else near - margin
    return dataclasses.replace(camera, near=array_of(near, camera.dtype), far=array_of(far + margin, camera.dtype))
