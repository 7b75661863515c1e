r"""One leg of a camera path: cameras at given times, and the camera at any time between (host side, float64).

Flow: keys -> [camera_leg: curves] -> camera path.

Curves of places, of rotations, and of the near and far depth are piecewise cubic with continuous first derivatives. Slopes at
inner keys are those of a parabola through three keys, no larger than three times the smaller of the mean slopes beside them: so
what stands still between two keys stands still, and what moves evenly moves evenly.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.spatial.transform import Rotation

from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.checks import is_traced

BACKWARD = np.array([[1.0], [1.0], [-1.0]])  # right, up and forward are left-handed; right, up and backward are a rotation
MAX_SLOPE = 3.0  # times the smaller of two mean slopes: a cubic whose ends are no steeper is monotone (Fritsch & Carlson 1980)

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
        eye = self._eyes(time) if self.around is None else self.around - axes.T @ self._seen(time)
        half_height, near, far = self._opening(time)
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
            np.array(numbers)
            for numbers in zip(*((float(one.half_height), *one.near_and_far()) for one in self.cameras), strict=True)
        )
        zoom = monotone(self._key_times, np.log(half))
        if not self.cameras[0].is_perspective:
            front, back = ordered(self._key_times, near, far)
            return lambda time: (math.exp(zoom(time)), float(front(time)), float(back(time)))
        front, back = ordered(self._key_times, np.log(near), np.log(far))
        return lambda time: (math.exp(zoom(time)), math.exp(front(time)), math.exp(back(time)))

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


def slopes(times: Float[np.ndarray, " keys"], mean: Float[np.ndarray, "intervals values"]) -> Float[np.ndarray, "keys values"]:
    """Slopes at keys, of the mean slopes in the intervals between them."""
    step = np.diff(times)[:, None]
    before, after = mean[:-1], mean[1:]
    parabola = (step[1:] * before + step[:-1] * after) / (step[1:] + step[:-1])
    size, one, other = (np.linalg.norm(value, axis=1, keepdims=True) for value in (parabola, before, after))
    inner = parabola * np.minimum(1, MAX_SLOPE * np.minimum(one, other) / np.where(size > 0, size, 1))
    return np.concatenate([mean[:1], inner, mean[-1:]])


def through(times: Float[np.ndarray, " keys"], values: Float[np.ndarray, "keys values"]) -> CubicHermiteSpline:
    """A curve through values at two keys or more."""
    mean = np.diff(values, axis=0) / np.diff(times)[:, None]
    return CubicHermiteSpline(times, values, slopes(times, mean))


def monotone(times: Float[np.ndarray, " keys"], values: Float[np.ndarray, " keys"]) -> Any:
    """A curve that stays between the values at the keys beside it (Fritsch & Butland 1984)."""
    return PchipInterpolator(times, values)


def ordered(
    times: Float[np.ndarray, " keys"], lower: Float[np.ndarray, " keys"], upper: Float[np.ndarray, " keys"]
) -> tuple[CubicHermiteSpline, CubicHermiteSpline]:
    r"""Two monotone curves of which the one stays below the other.

    On an interval of length $h$ a cubic has the Bernstein coefficients $f_0$, $f_0 + h m_0 / 3$, $f_1 - h m_1 / 3$ and $f_1$, so
    the lower curve is below where its four are. The outer ones are; slopes of both at a key are made smaller by one factor
    until the inner ones are. That leaves monotone curves monotone, as their slopes get smaller.
    """
    below, above = (PchipInterpolator(times, values).derivative()(times) for values in (lower, upper))
    gap, step = upper - lower, np.diff(times)
    closing = np.maximum(np.append(step, 0) * (below - above), np.append(0, step) * (above - below)) / 3
    share = 0.5 * gap / np.maximum(closing, 0.5 * gap)
    return CubicHermiteSpline(times, lower, share * below), CubicHermiteSpline(times, upper, share * above)


@dataclasses.dataclass(frozen=True)
class Turning:
    r"""Rotations on the shortest way from key to key, with a continuous angular velocity.

    From $R_0$ to $R_1$, $R(s) = R_0 \exp(\omega_1 B_1(s)) \exp(\omega_2 B_2(s)) \exp(\omega_3 B_3(s))$ with the cumulative
    Bernstein polynomials $B_1 = 1 - (1 - s)^3$, $B_2 = 3 s^2 - 2 s^3$, $B_3 = s^3$. $\omega_1$ and $\omega_3$ are a third of the
    angles that the angular velocities at the two keys give, and $\omega_2$ is what is left to $R_1$. Turning evenly about one
    axis is spherical linear interpolation.

    Attributes:
        times: of the keys, ascending.
        keys: one rotation a key.
        velocity: angular velocities at the keys, (keys, 3), radians a unit of time.

    References:
        Kim, Kim & Shin 1995, A general construction scheme for unit quaternion curves.
    """

    times: np.ndarray
    keys: Rotation
    velocity: np.ndarray

    @classmethod
    def through(cls, times: Float[np.ndarray, " keys"], keys: Rotation) -> Turning:
        """Through rotations at two keys or more; of two ways that are equally long, half a turn apart, it takes one."""
        turned = (keys[:-1].inv() * keys[1:]).as_rotvec()
        return cls(times, keys, slopes(times, turned / np.diff(times)[:, None]))

    def __call__(self, time: float) -> Rotation:
        """The rotation at a time between the first and the last key."""
        first = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2))
        step = self.times[first + 1] - self.times[first]
        share = (time - self.times[first]) / step
        begin, end = (Rotation.from_rotvec(step / 3 * self.velocity[key]) for key in (first, first + 1))
        middle = begin.inv() * self.keys[first].inv() * self.keys[first + 1] * end.inv()
        parts = (1 - (1 - share) ** 3, begin), (share**2 * (3 - 2 * share), middle), (share**3, end)
        found = self.keys[first]
        for weight, rotation in parts:
            found = found * Rotation.from_rotvec(weight * rotation.as_rotvec())
        return found
