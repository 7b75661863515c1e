"""Camera paths: a camera for every time, from key frames, around a point, or on the way to another camera.

Flow: cameras -> [camera_path] -> Camera of each frame -> render.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsph.model.camera.camera import BoundingBox, Camera
from jaxsph.model.camera.leg import Leg, made
from jaxsph.numerics.given import plain
from jaxsph.numerics.names import found

MAX_TURN = 90.0  # degrees between two keys of an orbit: well below half a turn, of which the shortest way is not one
NEAREST = 1e-3  # smallest near over far where a ball reaches the eye: sample depths are geometric between them


@dataclasses.dataclass(frozen=True, eq=False)
class CameraPath:
    """Cameras over time; make it with `from_keys` or `orbit`, and go on by `fly_to` and `then`.

    Between keys a camera turns on the shortest way and with no jump in speed; what it sees of depth and its zoom change
    geometrically, and never beyond those of the keys around. Times are of any unit; on the command line they are seconds.

    Attributes:
        legs: one after the other, each from where the last has ended.
    """

    legs: tuple[Leg, ...]

    def __post_init__(self) -> None:
        if not self.legs:
            raise ValueError("`legs` must be at least one, got none")
        for one, other in itertools.pairwise(self.legs):
            if one.times[-1] != other.times[0]:
                ends, begins = one.times[-1], other.times[0]
                raise ValueError(f"`legs` must follow each other, but one ends at {ends:g} and the next begins at {begins:g}")

    @classmethod
    def from_keys(cls, keys: Iterable[tuple[float, Camera]], *, around: Any = None, ease: bool = False) -> CameraPath:
        """Through cameras at given times.

        Args:
            keys: (time, camera), times ascending; all cameras of one width, height and projection.
            around: a point that the camera goes around, (3,), length units: its distance changes geometrically and its place
                in the image smoothly, so that views of one thing from several sides stay views of it. Without it the eye
                goes from key to key on a smooth curve.
            ease: whether the camera speeds up from rest, and comes to rest at the end.

        Raises:
            ValueError: times that do not ascend, cameras of different sizes, a point that is behind one of them.
        """
        pairs = [_pair(key) for key in keys]
        times = tuple(float(time) for time, _ in pairs)
        return cls((Leg(times, tuple(camera for _, camera in pairs), _point(around), ease),))

    @classmethod
    def orbit(
        cls,
        camera: Camera | None = None,
        degrees: float = 360.0,
        *,
        center: Any = None,
        radius: float | None = None,
        up: Any = (0.0, 1.0, 0.0),
        seconds: float = 10.0,
        **size: Any,
    ) -> CameraPath:
        """Around a point, evenly.

        Args:
            camera: where to begin; None begins where a ball of `radius` around `center` fills the image.
            degrees: how far around; positive is counterclockwise as seen from above.
            center: the point, (3,); by default the middle of what `camera` sees of depth, straight ahead.
            radius: of a ball around it that near and far are to hold; by default they are those of `camera`.
            up: axis.
            seconds: how long.
            size: where there is no camera, `width`, `height`, `fov_degrees` and `direction` of `Camera.framing`.

        Raises:
            ValueError: neither a camera nor a ball; numbers that are not finite, no axis.
        """
        axis, center, radius = _axis(up), plain("center", center), plain("radius", radius)
        for name, value in (("degrees", degrees), ("seconds", seconds)):
            if not np.isfinite(value) or (name == "seconds" and not value > 0):
                raise ValueError(f"`{name}` must be finite{' and > 0' if name == 'seconds' else ''}, got {value}")
        if camera is None:
            if center is None or radius is None:
                raise ValueError("`orbit` needs a `camera` to begin with, or `center` and `radius` of a ball to frame")
            if not (np.isfinite(radius) and radius > 0):
                raise ValueError(f"`radius` must be > 0 and finite, got {radius}")
            middle_of_ball = np.asarray(center, np.float64)
            camera = Camera.framing(BoundingBox(middle_of_ball - radius, middle_of_ball + radius), up=up, **size)
        elif size:
            raise ValueError(f"`{next(iter(size))}` is the camera's; leave it out")
        around = np.array(middle(camera) if center is None else _point(center))
        parts = max(math.ceil(abs(degrees) / MAX_TURN), 1)
        begun = camera if radius is None else _holding(camera, around, float(radius))
        keys = [_turned(begun, around, axis, degrees * part / parts) for part in range(parts + 1)]
        return cls.from_keys([(seconds * part / parts, key) for part, key in enumerate(keys)], around=around)

    def fly_to(self, camera: Camera, seconds: float, *, around: Any = "ahead", ease: bool = True) -> CameraPath:
        """This path, and from its end on to another camera.

        Args:
            camera: where to.
            seconds: how long.
            around: as in `from_keys`; by default the middle of what `camera` sees of depth, straight ahead, or None where
                that is behind the camera that it comes from.
            ease: whether it speeds up from rest and comes to rest again.
        """
        last = self.at(self.end)
        if isinstance(around, str):
            around = middle(camera)
            ahead = np.asarray(last.axes, np.float64)[2] @ (np.asarray(around) - last.exact_eye()) > 0
            around = around if ahead or not camera.is_perspective else None
        leg = Leg((self.end, self.end + float(seconds)), (last, camera), _point(around), ease)
        return CameraPath((*self.legs, leg))

    def then(self, other: CameraPath) -> CameraPath:
        """This path, and then another, whose times are moved; it should begin where this ends."""
        later = self.end - other.start
        moved = [dataclasses.replace(leg, times=tuple(time + later for time in leg.times)) for leg in other.legs]
        return CameraPath((*self.legs, *moved))

    @property
    def start(self) -> float:
        """Time of the first key."""
        return self.legs[0].times[0]

    @property
    def end(self) -> float:
        """Time of the last key."""
        return self.legs[-1].times[-1]

    def at(self, time: float) -> Camera:
        """The camera at a time; it stands still before the first key and after the last."""
        if not np.isfinite(time):
            raise ValueError(f"`time` must be finite, got {time}")
        leg = next((leg for leg in self.legs if time <= leg.times[-1]), self.legs[-1])
        return leg.at(float(time))

    def cameras(self, frames: int) -> list[Camera]:
        """So many cameras, evenly spaced in time, the first and the last key among them."""
        if frames < 1:
            raise ValueError(f"`frames` must be at least 1, got {frames}")
        return [self.at(float(time)) for time in np.linspace(self.start, self.end, frames)]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to `path`, a `.json`, whole or not at all. See `jaxsph.io.write_camera_path`."""
        found("jaxsph.io.json_files:write_camera_path")(path, self)

    @classmethod
    def load(cls, path: str | os.PathLike[str], **more: Any) -> CameraPath:
        """Read what `save`, or a person, wrote. See `jaxsph.io.read_camera_path` for `more`."""
        read: CameraPath = found("jaxsph.io.json_files:read_camera_path")(path, **more)
        return read


def middle(camera: Camera) -> tuple[float, float, float]:
    """The point straight ahead in the middle of what a camera sees of depth."""
    x, y, z = camera.exact_eye() + np.asarray(camera.axes, np.float64)[2] * sum(camera.near_and_far()) / 2
    return float(x), float(y), float(z)


def _pair(key: Any) -> tuple[Any, Any]:
    try:
        time, camera = key
        return float(time), camera
    except (TypeError, ValueError):
        raise ValueError(f"`keys` must be pairs (time, camera), got {type(key).__name__}") from None


def _point(point: Any) -> tuple[float, float, float] | None:
    if point is None:
        return None
    x = np.asarray(plain("around", point), np.float64)
    if x.shape != (3,) or not np.isfinite(x).all():
        raise ValueError(f"a point must be three finite numbers (x, y, z), got {np.asarray(point).tolist()}")
    return float(x[0]), float(x[1]), float(x[2])


def _axis(up: Any) -> np.ndarray:
    axis = np.asarray(plain("up", up), np.float64)
    length = np.linalg.norm(axis) if axis.shape == (3,) else 0
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"`up` must be an axis (x, y, z), got {axis.tolist()}")
    return axis / length


def _holding(camera: Camera, center: np.ndarray, radius: float) -> Camera:
    """The camera with near and far at a ball."""
    axes = np.asarray(camera.axes, np.float64)
    depth = float(axes[2] @ (center - camera.exact_eye()))
    near, far = depth - radius, depth + radius
    if camera.is_perspective:
        near = max(near, NEAREST * far)
    if not near < far:
        raise ValueError(f"`radius` = {radius} around `center` must be > 0 and in front of the camera")
    return made(camera.exact_eye(), axes, float(camera.half_height), near, far, camera)


def _turned(camera: Camera, center: np.ndarray, axis: np.ndarray, degrees: float) -> Camera:
    turn = Rotation.from_rotvec(np.radians(degrees) * axis)
    axes, eye = turn.apply(np.array(camera.axes, np.float64)), center + turn.apply(camera.exact_eye() - center)
    return made(eye, axes, float(camera.half_height), *camera.near_and_far(), camera)
