"""One leg of a camera path: cameras at given times, and the camera at any time between (host side, float64).

Flow: keys, curves -> [camera_leg] -> camera path.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.curves import Turning, monotone, ordered, through
from jaxsph.numerics.checks import is_traced

BACKWARD = np.array([[1.0], [1.0], [-1.0]])
"""Right, up and forward are left-handed; right, up and backward are a rotation."""

Values = Callable[[float], Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Leg:
    """Cameras at times that ascend, all of one size and projection.

    Attributes:
        times: of the keys.
        cameras: one a key.
        around: the point that the camera goes around; None: the eye goes from key to key on a smooth curve.
        ease: whether the camera speeds up from rest, and comes to rest at the end.
    """

    times: tuple[float, ...]
    cameras: tuple[Camera, ...]
    around: tuple[float, float, float] | None = None
    ease: bool = False

    def __post_init__(self) -> None:
        _require_times(self.times)
        for time, camera in zip(self.times, self.cameras, strict=True):
            _require_like(self.cameras[0], camera, time)
        if self.around is not None:
            if len(self.around) != 3 or not np.isfinite(self.around).all():
                raise ValueError(f"`around` must be a point (x, y, z), got {self.around}; None goes straight")
            self._require_in_front()

    def _require_in_front(self) -> None:
        behind = [time for time, place in zip(self.times, self._places(), strict=True) if not place[2] > 0]
        if behind and self.cameras[0].is_perspective:
            raise ValueError(
                f"`around` = {self.around} must be in front of every camera, but is behind that of time {behind[0]:g}; "
                "choose another point, or None"
            )

    def at(self, time: float) -> Camera:
        """The camera at a time; before the first key and after the last it stands still."""
        begin, end = self.times[0], self.times[-1]
        time = min(max(time, begin), end)
        if len(self.times) == 1:
            return self.cameras[0]
        if self.ease:
            share = (time - begin) / (end - begin)
            time = begin + (end - begin) * share**2 * (3 - 2 * share)
        axes = BACKWARD * self._turning(time).as_matrix()
        eye, (half_height, near, far) = self._eye(time, axes), self._opening(time)
        return made(eye, axes, half_height, near, far, self.cameras[0])

    @functools.cached_property
    def _key_times(self) -> np.ndarray:
        return np.asarray(self.times, np.float64)

    @functools.cached_property
    def _turning(self) -> Callable[[float], Rotation]:
        return Turning.through(self._key_times, self._rotations)

    @functools.cached_property
    def _rotations(self) -> Rotation:
        return Rotation.from_matrix([BACKWARD * np.asarray(one.axes, np.float64) for one in self.cameras])

    @functools.cached_property
    def _opening(self) -> Values:
        """Half of the visible height, near and far: geometrically where they are positive by nature."""
        half, near, far = (
            np.array([float(getattr(one, name)) for one in self.cameras]) for name in ("half_height", "near", "far")
        )
        zoom = monotone(self._key_times, np.log(half))
        if not self.cameras[0].is_perspective:
            front, back = ordered(self._key_times, near, far)
            return lambda time: (math.exp(zoom(time)), float(front(time)), float(back(time)))
        front, back = ordered(self._key_times, np.log(near), np.log(far))
        return lambda time: (math.exp(zoom(time)), math.exp(front(time)), math.exp(back(time)))

    def _eye(self, time: float, axes: np.ndarray) -> np.ndarray:
        return self._eyes(time) if self.around is None else self.around - axes.T @ self._seen(time)

    @functools.cached_property
    def _eyes(self) -> Values:
        return through(self._key_times, np.array([one.exact_eye() for one in self.cameras]))

    @functools.cached_property
    def _seen(self) -> Values:
        """Where the point `around` is in view space: its depth geometrically, its place in the image smoothly."""
        place = np.array(self._places())
        if not self.cameras[0].is_perspective:
            return through(self._key_times, place)
        depth = monotone(self._key_times, np.log(place[:, 2]))
        in_image = through(self._key_times, place[:, :2] / place[:, 2:])
        return lambda time: math.exp(depth(time)) * np.append(in_image(time), 1.0)

    def _places(self) -> list[np.ndarray]:
        axes = BACKWARD * self._rotations.as_matrix()
        return [axes[key] @ (np.asarray(self.around) - one.exact_eye()) for key, one in enumerate(self.cameras)]


def made(eye: Any, axes: np.ndarray, half_height: float, near: float, far: float, like: Camera) -> Camera:
    """A camera of the size and projection of another."""
    target, up = eye + axes[2] * max(abs(near), abs(far)), axes[1]
    if like.is_perspective:
        opening = 2 * math.degrees(math.atan(half_height))
        found = Camera.look_at(eye, target, up, opening, like.width, like.height, near=near, far=far)
    else:
        found = Camera.orthographic(eye, target, up, 2 * half_height, like.width, like.height, near=near, far=far)
    return found if like.stride == 1 else found.strided(like.stride)


def _require_times(times: Sequence[float]) -> None:
    if not times:
        raise ValueError("`keys` must be at least one (time, camera), got none")
    wrong = [time for time in times if not np.isfinite(time)]
    if wrong:
        raise ValueError(f"times of `keys` must be finite, got {wrong[0]}")
    for before, after in itertools.pairwise(times):
        if not before < after:
            raise ValueError(f"times of `keys` must ascend, but {after:g} follows {before:g}; sort them, one camera a time")


def _require_like(first: Camera, camera: Any, time: float) -> None:
    if not isinstance(camera, Camera):
        raise ValueError(f"`keys` must be pairs (time, camera), but at time {time:g} there is {type(camera).__name__}")
    if is_traced(camera):
        raise ValueError("`keys` must be concrete cameras; make the path outside jit")
    for name in ("width", "height", "projection", "stride"):
        if getattr(camera, name) != getattr(first, name):
            raise ValueError(
                f"all cameras of `keys` must have the same {name}, but that of time {time:g} has {getattr(camera, name)!r} "
                f"and the first {getattr(first, name)!r}"
            )
