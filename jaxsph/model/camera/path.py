"""Camera paths: a camera for every time, from key frames, around a point, or on the way to another camera.

Flow: cameras -> [path: legs] -> Camera of each frame -> render.

Curves of places, of rotations, and of the near and far depth are piecewise cubic with continuous first derivatives. Slopes at
inner keys are those of a parabola through three keys, no larger than three times the smaller of the mean slopes beside them: so
what stands still between two keys stands still, and what moves evenly moves evenly.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxsph.model.camera.camera import BoundingBox, Camera
from jaxsph.model.camera.directions import NEAREST
from jaxsph.model.json_form import WithJson
from jaxsph.numerics.checks import is_traced, plain, typed, vector_of

BACKWARD = np.array([[1.0], [1.0], [-1.0]])  # right, up and forward are left-handed; right, up and backward are a rotation
MAX_SLOPE = 3.0  # times the smaller of two mean slopes: a cubic whose ends are no steeper is monotone (Fritsch & Carlson 1980)
MAX_TURN = 90.0  # degrees between two keys of an orbit: well below half a turn, of which the shortest way is not one
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
        if not self.times:
            raise ValueError("`keys` must be at least one (time, camera), got none")
        for time, camera in zip(self.times, self.cameras, strict=True):
            if not np.isfinite(time):
                raise ValueError(f"times of `keys` must be finite, got {time}")
            if not isinstance(camera, Camera):
                raise ValueError(f"`keys` must be pairs (time, camera), but at time {time:g} there is {type(camera).__name__}")
            if is_traced(camera):
                raise ValueError("`keys` must be concrete cameras; make the path outside jit")
            for name in ("width", "height", "projection", "stride"):
                own, first = getattr(camera, name), getattr(self.cameras[0], name)
                if own != first:
                    told = f"but that of time {time:g} has {own!r} and the first {first!r}"
                    raise ValueError(f"all cameras of `keys` must have the same {name}, {told}")
        for before, after in itertools.pairwise(self.times):
            if not before < after:
                told = f"but {after:g} follows {before:g}; sort them, one camera a time"
                raise ValueError(f"times of `keys` must ascend, {told}")
        if self.around is not None:
            point = tuple(vector_of("around", self.around, "give a point x, y and z, or None").tolist())
            object.__setattr__(self, "around", point)
            behind = [time for time, place in zip(self.times, self._places(), strict=True) if not place[2] > 0]
            if behind and self.cameras[0].is_perspective:
                wrong = f"`around` = {point} must be in front of every camera, but is behind that of time {behind[0]:g};"
                raise ValueError(f"{wrong} choose another point, or None")

    def at(self, time: float) -> Camera:
        """The camera at a time; before the first key and after the last it stands still."""
        begin, end = self.times[0], self.times[-1]
        time = min(max(time, begin), end)
        if len(self.times) == 1:
            return self.cameras[0]
        if self.ease:
            share = (time - begin) / (end - begin)
            time = begin + (end - begin) * share**2 * (3 - 2 * share)
        turned, opening, place = self._curves
        axes = BACKWARD * turned(time).as_matrix()
        eye = place(time) if self.around is None else self.around - axes.T @ place(time)
        half_height, near, far = opening(time)
        return made(eye, axes, half_height, near, far, self.cameras[0])

    @functools.cached_property
    def _curves(self) -> tuple[Callable[[float], Rotation], Values, Values]:
        """Over time: axes; half of the visible height, near and far, geometrically where they are positive by nature; and the
        eye, or where the point `around` is in view space: its depth geometrically, its place in the image smoothly.
        """
        times, deep = np.asarray(self.times, np.float64), self.cameras[0].is_perspective
        half, *ends = np.array([(float(one.half_height), *one.near_and_far()) for one in self.cameras]).T
        zoom = scipy.interpolate.PchipInterpolator(times, np.log(half))
        front, back = ordered(times, *(np.log(ends) if deep else ends))

        def opening(time: float) -> tuple[float, float, float]:
            near, far = float(front(time)), float(back(time))
            return math.exp(zoom(time)), *((math.exp(near), math.exp(far)) if deep else (near, far))

        turned = turning(times, Rotation.from_matrix(self._axes()))
        if self.around is None or not deep:
            eyes = [one.exact_eye() for one in self.cameras]
            return turned, opening, through(times, np.array(eyes if self.around is None else self._places()))
        place = np.array(self._places())
        depth = scipy.interpolate.PchipInterpolator(times, np.log(place[:, 2]))
        in_image = through(times, place[:, :2] / place[:, 2:])
        return turned, opening, lambda time: math.exp(depth(time)) * np.append(in_image(time), 1.0)

    def _axes(self) -> list[np.ndarray]:
        return [BACKWARD * one.exact_axes() for one in self.cameras]

    def _places(self) -> list[np.ndarray]:
        """Where the point `around` is in the views of the keys."""
        axes = BACKWARD * Rotation.from_matrix(self._axes()).as_matrix()
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


def slopes(times: Float[np.ndarray, " keys"], mean: Float[np.ndarray, "intervals values"]) -> Float[np.ndarray, "keys values"]:
    """Slopes at keys, of the mean slopes in the intervals between them."""
    step = np.diff(times)[:, None]
    before, after = mean[:-1], mean[1:]
    parabola = (step[1:] * before + step[:-1] * after) / (step[1:] + step[:-1])
    size, one, other = (np.linalg.norm(value, axis=1, keepdims=True) for value in (parabola, before, after))
    inner = parabola * np.minimum(1, MAX_SLOPE * np.minimum(one, other) / np.where(size > 0, size, 1))
    return np.concatenate([mean[:1], inner, mean[-1:]])


def through(times: Float[np.ndarray, " keys"], values: Float[np.ndarray, "keys values"]) -> Any:
    """A curve through values at two keys or more."""
    mean = np.diff(values, axis=0) / np.diff(times)[:, None]
    return scipy.interpolate.CubicHermiteSpline(times, values, slopes(times, mean))


def ordered(
    times: Float[np.ndarray, " keys"], lower: Float[np.ndarray, " keys"], upper: Float[np.ndarray, " keys"]
) -> tuple[Any, Any]:
    r"""Two monotone curves of which the one stays below the other.

    On an interval of length $h$ a cubic has the Bernstein coefficients $f_0$, $f_0 + h m_0 / 3$, $f_1 - h m_1 / 3$ and $f_1$, so
    the lower curve is below where its four are. The outer ones are; slopes of both at a key are made smaller by one factor
    until the inner ones are. That leaves monotone curves monotone, as their slopes get smaller.
    """
    below, above = (scipy.interpolate.PchipInterpolator(times, values).derivative()(times) for values in (lower, upper))
    gap, step = upper - lower, np.diff(times)
    closing = np.maximum(np.append(step, 0) * (below - above), np.append(0, step) * (above - below)) / 3
    share = 0.5 * gap / np.maximum(closing, 0.5 * gap)
    hermite = scipy.interpolate.CubicHermiteSpline
    return hermite(times, lower, share * below), hermite(times, upper, share * above)


def turning(times: Float[np.ndarray, " keys"], keys: Rotation) -> Callable[[float], Rotation]:
    r"""Rotations on the shortest way from key to key, two or more, with a continuous angular velocity.

    From $R_0$ to $R_1$, $R(s) = R_0 \exp(\omega_1 B_1(s)) \exp(\omega_2 B_2(s)) \exp(\omega_3 B_3(s))$ with the cumulative
    Bernstein polynomials $B_1 = 1 - (1 - s)^3$, $B_2 = 3 s^2 - 2 s^3$, $B_3 = s^3$. $\omega_1$ and $\omega_3$ are a third of the
    angles that the angular velocities at the two keys give, and $\omega_2$ is what is left to $R_1$. Turning evenly about one
    axis is spherical linear interpolation. Of two ways that are equally long, half a turn apart, it takes one.

    References:
        Kim, Kim & Shin 1995, A general construction scheme for unit quaternion curves.
    """
    turned = (keys[:-1].inv() * keys[1:]).as_rotvec()
    velocity = slopes(times, turned / np.diff(times)[:, None])

    def at(time: float) -> Rotation:
        first = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        step = times[first + 1] - times[first]
        share = (time - times[first]) / step
        begin, end = (Rotation.from_rotvec(step / 3 * velocity[key]) for key in (first, first + 1))
        middle = begin.inv() * keys[first].inv() * keys[first + 1] * end.inv()
        found = keys[first]
        for weight, part in ((1 - (1 - share) ** 3, begin), (share**2 * (3 - 2 * share), middle), (share**3, end)):
            found = found * Rotation.from_rotvec(weight * part.as_rotvec())
        return found

    return at


@dataclasses.dataclass(frozen=True, eq=False)
class CameraPath(WithJson):
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
        if not isinstance(keys, Iterable):
            raise ValueError(f"`keys` must be pairs (time, camera), got {type(keys).__name__}")
        times, cameras = [], []
        for key in keys:
            try:
                time, camera = key
                times.append(float(time))
            except (TypeError, ValueError):
                raise ValueError(f"`keys` must be pairs (time, camera), got {type(key).__name__}") from None
            cameras.append(camera)
        return cls((Leg(tuple(times), tuple(cameras), around, ease),))

    @classmethod
    @typed
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
        axis, radius = vector_of("up", up, "give an axis x, y and z"), plain("radius", radius)
        center = None if center is None else vector_of("center", center)
        if not axis.any():
            raise ValueError("`up` must not be (0, 0, 0): it is the axis; give x, y and z")
        axis = axis / np.linalg.norm(axis)
        for name, value in (("degrees", degrees), ("seconds", seconds)):
            if not np.isfinite(value) or (name == "seconds" and not value > 0):
                raise ValueError(f"`{name}` must be finite{' and > 0' if name == 'seconds' else ''}, got {value}")
        if camera is None:
            if center is None or radius is None:
                raise ValueError("`orbit` needs a `camera` to begin with, or `center` and `radius` of a ball to frame")
            if not (np.isfinite(radius) and radius > 0):
                raise ValueError(f"`radius` must be > 0 and finite, got {radius}")
            camera = Camera.framing(BoundingBox(center - radius, center + radius), up=up, **size)
        elif size:
            raise ValueError(f"`{next(iter(size))}` is the camera's; leave it out")
        around = np.array(middle(camera)) if center is None else center
        parts = max(math.ceil(abs(degrees) / MAX_TURN), 1)
        begun = camera if radius is None else _holding(camera, around, float(radius))
        eye, axes = begun.exact_eye() - around, np.array(begun.axes, np.float64)
        opening, keys = (float(begun.half_height), *begun.near_and_far()), []
        for part in range(parts + 1):
            turn = Rotation.from_rotvec(np.radians(degrees * part / parts) * axis)
            keys.append((seconds * part / parts, made(around + turn.apply(eye), turn.apply(axes), *opening, begun)))
        return cls.from_keys(keys, around=around)

    @typed
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
            ahead = last.exact_axes()[2] @ (np.asarray(around) - last.exact_eye()) > 0
            around = around if ahead or not camera.is_perspective else None
        leg = Leg((self.end, self.end + float(seconds)), (last, camera), around, ease)
        return CameraPath((*self.legs, leg))

    @typed
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

    @typed
    def at(self, time: float) -> Camera:
        """The camera at a time; it stands still before the first key and after the last."""
        if not np.isfinite(time):
            raise ValueError(f"`time` must be finite, got {time}")
        leg = next((leg for leg in self.legs if time <= leg.times[-1]), self.legs[-1])
        return leg.at(float(time))

    @typed
    def cameras(self, frames: int) -> list[Camera]:
        """So many cameras, evenly spaced in time, the first and the last key among them."""
        if frames < 1:
            raise ValueError(f"`frames` must be at least 1, got {frames}")
        return [self.at(float(time)) for time in np.linspace(self.start, self.end, frames)]


def middle(camera: Camera) -> tuple[float, float, float]:
    """The point straight ahead in the middle of what a camera sees of depth."""
    x, y, z = camera.exact_eye() + camera.exact_axes()[2] * sum(camera.near_and_far()) / 2
    return float(x), float(y), float(z)


def _holding(camera: Camera, center: np.ndarray, radius: float) -> Camera:
    """The camera with near and far at a ball."""
    axes = camera.exact_axes()
    depth = float(axes[2] @ (center - camera.exact_eye()))
    near, far = depth - radius, depth + radius
    if camera.is_perspective:
        near = max(near, NEAREST * far)
    if not near < far:
        raise ValueError(f"`radius` = {radius} around `center` must be > 0 and in front of the camera")
    return made(camera.exact_eye(), axes, float(camera.half_height), near, far, camera)
