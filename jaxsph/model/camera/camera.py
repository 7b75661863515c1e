"""Camera: where the scene is looked at from, and where samples sit along its rays.

Flow: [camera] -> access -> cast -> image.

View space has the eye at the origin, x right, y up and z forward (depth). The ray of pixel (row r, column c) passes
`(s^p u_c, s^p v_r, s)` at depth s, with p = 1 for a perspective camera (u, v are tangents) and p = 0 for an orthographic
one (u, v are lengths). Samples are uniform in *sample space* `[0, N]`.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxsph.model.camera.directions import NEAREST, OBLIQUE, ROUNDING, VIEWS, corners_of, filled, sight
from jaxsph.numerics.checks import array_of, as_usual, at_hand, is_traced, one_number, plain, vector_of
from jaxsph.numerics.names import import_by_name
from jaxsph.numerics.trees import OPEN, Placed, kind_of, line_of, numbers_in, on_host, row_of, span_of, tree

MAX_SIDE = 65536  # pixels; larger images overflow 32-bit ids long after memory is gone


@runtime_checkable
class Bounded(Protocol):
    """What can be framed: particles, a volume, points."""

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around it, (3,) and (3,), float64, length units."""


class BoundingBox(NamedTuple):
    """A box as something to frame."""

    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def around(cls, parts: Iterable[Bounded]) -> BoundingBox:
        """The box around several parts; those that are empty have none, and the box of nothing is that of zeros."""
        boxes = [part.bounds() for part in parts]
        filled = [(lower, upper) for lower, upper in boxes if (upper > lower).any()]
        if not filled:
            return cls(np.zeros(3), np.zeros(3))
        return cls(np.min([lower for lower, _ in filled], 0), np.max([upper for _, upper in filled], 0))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Bounded`."""
        return self.lower, self.upper


@tree(static=("width", "height", "projection", "stride"))
class Camera(Placed):
    """A perspective or orthographic camera; make it with `look_at`, `orthographic`, `framing` or `along_axis`.

    Lengths are numbers in the unit of positions, which a camera does not know: what carries a unit is refused.

    Attributes:
        eye: position of the eye in world space, length units.
        axes: rows are right, up and forward, orthonormal.
        half_height: tan(fov / 2), or half the visible height (length units) if orthographic.
        near: depth of the first sample slab's front, length units; > 0 if perspective. None is "from the scene".
        far: depth of the last sample slab's back, > near; or None.
        width: pixels a row.
        height: rows.
        projection: `"perspective"` or `"orthographic"`.
        eye_rest: what rounding a float64 eye to `eye` has left, length units; None is nothing.
        stride: rays go through every so many pixels of either direction, and through the last: see `strided`.
        snug: near and far found for a picture, which has them where its camera's own are None; columns go through all there is.
    """

    PLACE, REST = "eye", "eye_rest"
    eye: Float[Array, "3"]
    axes: Float[Array, "3 3"]
    half_height: Float[Array, ""]
    near: Float[Array, ""] = dataclasses.field(metadata=OPEN)
    far: Float[Array, ""] = dataclasses.field(metadata=OPEN)
    width: int = 512
    height: int = 512
    projection: str = "perspective"
    eye_rest: Float[Array, "3"] | None = None
    stride: int = 1
    snug: Float[Array, "2"] | None = None

    def __repr__(self) -> str:
        half = numbers_in(self.half_height)
        if half is None or half.ndim:
            opening = f"half_height {kind_of(self.half_height)}"
        else:
            fov = f"fov {math.degrees(2 * math.atan(half)):.4g} degrees"
            opening = fov if self.is_perspective else f"view_height {2 * float(half):.4g}"
        axes = numbers_in(self.axes)
        forward = None if axes is None or axes.ndim != 2 else f"forward {row_of(axes[2])}"
        depths = {"near": self.near, "far": self.far}
        ends = ", ".join(f"{name} {'of the scene' if end is None else span_of(end)}" for name, end in depths.items())
        size = f"{self.projection}, {self.width} x {self.height}"
        return line_of("Camera", size, f"eye {row_of(self.eye)}", forward, opening, ends)

    @classmethod
    def look_at(
        cls,
        eye: Any,
        target: Any,
        up: Any = (0.0, 1.0, 0.0),
        fov_degrees: Any = 45.0,
        width: int = 512,
        height: int = 512,
        *,
        near: Any = None,
        far: Any = None,
    ) -> Camera:
        """Perspective camera at `eye` that looks at `target`.

        Args:
            eye: (3,) world position, length units.
            target: (3,) world position in the middle of the image, not the eye.
            up: (3,) direction that points upwards in the image; not parallel to the line of sight.
            fov_degrees: vertical field of view, in (0, 180).
            width, height: size in pixels, at least 1.
            near, far: depths between which samples are taken, 0 < near < far, length units. The depth of a sample is
                `near * (far / near) ** (u / N)`: snug values sample better. None is "from the scene": `jaxsph.render`, `plan`,
                `progressive`, `project` and the reference find what is snug; under `jit` both must be given.

        Raises:
            ValueError: for sizes, angles or depths out of range, or directions that do not span a view.
        """
        fov_degrees = one_number("fov_degrees", fov_degrees, "it is a number of degrees", "of 'deg'")
        require_fov(fov_degrees)
        traced = is_traced(fov_degrees)
        half = jnp.tan(jnp.asarray(fov_degrees) * (math.pi / 360)) if traced else math.tan(math.radians(fov_degrees) / 2)
        return _make(eye, target, up, half, width, height, near, far, "perspective")

    @classmethod
    def orthographic(
        cls,
        eye: Any,
        target: Any,
        up: Any = (0.0, 1.0, 0.0),
        view_height: Any = 1.0,
        width: int = 512,
        height: int = 512,
        *,
        near: Any = None,
        far: Any = None,
    ) -> Camera:
        """Camera with parallel rays.

        Args:
            eye: (3,) world position from which depths are counted, length units.
            target: (3,) world position in the middle of the image, not the eye.
            up: (3,) direction that points upwards in the image; not parallel to the line of sight.
            view_height: visible height, > 0, length units.
            width, height: size in pixels, at least 1.
            near, far: depths between which samples are taken, linearly; may be negative. None is as in `look_at`.

        Raises:
            ValueError: as `look_at`, and for `view_height` <= 0.
        """
        view_height = one_number("view_height", view_height)
        if not is_traced(view_height) and not (np.isfinite(view_height) and view_height > 0):
            raise ValueError(f"`view_height` must be > 0 and finite, got {view_height}; it is the visible height in length units")
        return _make(eye, target, up, view_height * 0.5, width, height, near, far, "orthographic")

    @classmethod
    @on_host
    def framing(
        cls,
        particles: Bounded,
        *,
        direction: Any = OBLIQUE,
        up: Any = (0.0, 1.0, 0.0),
        fov_degrees: float = 45.0,
        width: int = 512,
        height: int = 512,
        margin: float = 1.05,
    ) -> Camera:
        """Perspective camera that frames particles, a volume or points: everything in view, near and far snug (host side).

        Args:
            particles: what to look at, particles, a volume or points; an empty set is framed as the unit box.
            direction: line of sight, from the eye to the middle of it.
            up: as `look_at`.
            fov_degrees: vertical field of view.
            width, height: size in pixels.
            margin: 1 fills the image to its edge, larger leaves a border.
        """
        require_size(width, height)
        lower, upper = filled(particles.bounds())
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
        return cls.look_at(eye, middle, up, fov_degrees, width, height, near=near * 0.999, far=float(far) * 1.001)

    @classmethod
    @on_host
    def along_axis(
        cls,
        shown: Bounded,
        axis: Any = "z",
        width: int = 512,
        height: int = 512,
        *,
        margin: float = 1.0,
        depth_range: tuple[float, float] | None = None,
        up: Any = None,
    ) -> Camera:
        """Orthographic camera along an axis that shows all of what there is (host side).

        Args:
            shown: particles, a volume, points, or a scene.
            axis: `"x"` shows y (right) and z (up), seen from large x; `"y"` x and z, seen from small y; `"z"` x and y, from
                large z. Or a line of sight of length 1, which needs an `up`.
            width, height: size in pixels.
            margin: 1 fills the image to its edge, larger leaves a border.
            depth_range: coordinates along the axis between which rays are followed; by default all.
            up: (3,) direction that is up instead, seen from above along that.

        Raises:
            ValueError: another axis, or coordinates that do not ascend.
        """
        if isinstance(axis, str) and axis not in VIEWS:
            raise ValueError(f"`axis` must be 'x', 'y' or 'z', got {axis!r}")
        require_size(width, height)
        up = up if up is None else vector_of("up", up)
        along = (axis, up) if not isinstance(axis, str) else VIEWS[axis] if up is None else sight(axis, up)
        forward, up = (np.asarray(direction, np.float64) for direction in along)
        right, up, _ = axes_along(forward, up)
        lower, upper = filled(shown.bounds())
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
        return cls.orthographic(eye, middle, up, view_height, width, height, near=near, far=far)

    @classmethod
    @on_host
    def fitted(cls, scene: Any, *, width: int = 512, height: int = 512, **view: Any) -> Camera:
        """A camera that shows a scene, by default the central 99 % of what is lit in most of the picture (host side).

        Args:
            scene: with its looks.
            width, height: size in pixels.
            view: as for `jaxsph.io.opening.options.View`: `center=` a place or `"densest"`; `across=` the width of the picture, a
                length; `view=` `"x"`, `"y"`, `"z"`, `"iso"` or a direction; `up=`, `fov_degrees=`, `frame_all=`.

        Raises:
            ValueError: an option that there is not, or that does not suit the scene.
        """
        return import_by_name("jaxsph.io.opening.views:fitted_camera")(scene, (width, height), **view)  # type: ignore[no-any-return]  # 320 ms

    @property
    def is_perspective(self) -> bool:
        """Whether rays spread from the eye (static)."""
        return self.projection == "perspective"

    def to_view(self, position: Float[Array, "... 3"], rest: Float[Array, "... 3"] | None = None) -> Float[Array, "... 3"]:
        """World to view coordinates of `position + rest`."""
        return self.rotate(self.offset(position, rest))

    def offset(self, position: Float[Array, "... 3"], rest: Float[Array, "... 3"] | None = None) -> Float[Array, "... 3"]:
        """World coordinates of `position + rest`, relative to the eye: to a few eps of themselves, wherever the eye is.

        Differentiation:
            By places alone: their low digits move with them, and would else carry the same slope a second time.
        """
        offset = position - self.eye
        small = self.eye_rest if rest is None or self.eye_rest is None else self.eye_rest - rest
        if small is None:
            return offset if rest is None else offset + lax.stop_gradient(rest)
        return offset - lax.stop_gradient(small)

    def rotate(self, offset: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """World directions to view directions."""
        rows = [offset[..., 0] * axis[0] + offset[..., 1] * axis[1] + offset[..., 2] * axis[2] for axis in self.axes]
        return jnp.stack(rows, -1)

    def depth(self, u: Float[Array, "..."], samples: int) -> Float[Array, "..."]:
        """Depth s(u) of sample-space coordinate `u` in [0, samples]: geometric if perspective, else linear."""
        part = u / samples
        if self.is_perspective:
            return self.near * jnp.exp(part * jnp.log(self.far / self.near))
        return self.near + (self.far - self.near) * part

    def strided(self, stride: int) -> Camera:
        """The same view with a ray for every `stride`-th pixel of a row and a column, and for the last: node k at k + 1/2."""
        return dataclasses.replace(self, stride=stride)

    @property
    def nodes(self) -> tuple[int, int]:
        """Rows and columns of rays."""
        return num_nodes(self.height, self.stride), num_nodes(self.width, self.stride)

    def column(self, c: Float[Array, "..."]) -> Float[Array, "..."]:
        """Lateral ray coordinate u of image-space abscissa `c` in [0, width]; pixel c has its ray at c + 1/2."""
        c = self._pixel(c, self.width)
        return self.half_height * (self.width / self.height) * (2 * c / self.width - 1)

    def row(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """Vertical ray coordinate v of image-space ordinate `r` in [0, height], from the top; pixel r sits at r + 1/2."""
        r = self._pixel(r, self.height)
        return self.half_height * (1 - 2 * r / self.height)

    def _pixel(self, place: Float[Array, "..."], size: int) -> Float[Array, "..."]:
        return place if self.stride == 1 else jnp.minimum((place - 0.5) * self.stride, size - 1) + 0.5

    def near_and_far(self) -> tuple[float, float]:
        """Both depths of a picture as numbers, length units (host side); `ValueError` where one is to be that of a scene."""
        own = self.for_picture()
        if own.near is None or own.far is None:
            raise ValueError("`near` and `far` must be numbers here, where no scene tells them; give both to the camera")
        return float(own.near), float(own.far)

    def for_picture(self) -> Camera:
        """With depths that were found for a picture, as far as none are given."""
        if self.snug is None:
            return self
        ends = dict(zip(("near", "far"), at_hand(self.snug)[1], strict=True))
        found: Any = {name: array_of(end) for name, end in ends.items() if getattr(self, name) is None}
        return dataclasses.replace(self, snug=None, **found)

    def exact_eye(self) -> np.ndarray:
        """The eye in float64, (3,), with what float32 could not hold (host side)."""
        eye = np.asarray(self.eye, np.float64)
        return eye if self.eye_rest is None else eye + np.asarray(self.eye_rest, np.float64)

    def exact_axes(self) -> np.ndarray:
        """The axes in float64, (3, 3): rows right, true up, forward (host side)."""
        return np.asarray(self.axes, np.float64)

    def exact_view(self, position: np.ndarray) -> np.ndarray:
        """View coordinates of world coordinates, (..., 3) float64 (host side)."""
        return np.asarray((position - self.exact_eye()) @ self.exact_axes().T)

    def exact_world(self, place: np.ndarray) -> np.ndarray:
        """World coordinates of view coordinates, (..., 3) float64 (host side)."""
        return np.asarray(place @ self.exact_axes() + self.exact_eye())

    def exact_rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Lateral coordinates u of columns and v of rows, through the middles of pixels, float64 (host side)."""
        half = float(self.half_height)
        columns, rows = (np.arange(size) + 0.5 for size in (self.width, self.height))
        return half * self.width / self.height * (2 * columns / self.width - 1), half * (1 - 2 * rows / self.height)

    def describe(self) -> str:
        """One line for metadata: projection, size, eye, axes, opening, near and far."""
        eye, axes = self.exact_eye().tolist(), np.asarray(self.axes).round(9).tolist()
        opening = f"{'tan(fov/2)' if self.is_perspective else 'half_height'}={float(self.half_height):.9g}"
        size, (near, far) = f"{self.width}x{self.height}", self.near_and_far()
        return f"{self.projection} {size} eye={eye} axes={axes} {opening} near={near:.9g} far={far:.9g}"


def num_nodes(size: int, stride: int) -> int:
    """Rays of `size` pixels side by side, of which every `stride`-th has one, and the last."""
    return -(-(size - 1) // stride) + 1


def require_fov(fov_degrees: Any) -> None:
    """Raise where a known angle is no field of view."""
    if not is_traced(fov_degrees) and not 0 < float(fov_degrees) < 180:
        raise ValueError(f"`fov_degrees` must lie in (0, 180), got {fov_degrees}; it is the vertical field of view")


def require_size(width: Any, height: Any) -> None:
    """Raise where a picture cannot be of this size."""
    for name, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, int | np.integer) or not 1 <= size <= MAX_SIDE:
            raise ValueError(f"`{name}` must be an integer from 1 to {MAX_SIDE} pixels, got {size!r}")


def axes_along(forward: Any, up: Any, xp: Any = np) -> Any:
    """Rows right, true up, forward, which is of length 1: right = normalise(forward x up), up = right x forward."""
    right = xp.cross(forward, up)
    right = right / xp.sqrt((right * right).sum())
    return xp.stack([right, xp.cross(right, forward), forward])


@as_usual()
def _make(eye: Any, target: Any, up: Any, half: Any, width: int, height: int, near: Any, far: Any, projection: str) -> Camera:
    require_size(width, height)
    given = {"eye": eye, "target": target, "up": up}
    eye, target, up = (plain(name, value) for name, value in given.items())
    near, far = (end if end is None else one_number(name, end) for name, end in (("near", near), ("far", far)))
    xp: Any = jnp
    if not is_traced(eye, target, up, half, near, far):
        xp = np
        _check_view(eye, target, up, near, far, projection)
        eye, target, up = (np.asarray(v, np.float64 if not hasattr(v, "dtype") else None) for v in (eye, target, up))
    eye, target, up = (xp.asarray(v) for v in (eye, target, up))
    wide = [v for v in (eye, target) if v.dtype == jnp.float64]
    if xp is np:
        eye, target = eye.astype(np.float64), target.astype(np.float64)
    forward = (target - eye).astype(jnp.float64 if xp is np else jnp.result_type(target, jnp.float32))
    forward = forward / xp.sqrt((forward * forward).sum())
    axes = axes_along(forward, up.astype(forward.dtype), xp)
    dtype = jnp.promote_types(jax.dtypes.canonicalize_dtype(wide[0].dtype if wide else jnp.float32), jnp.float32)
    rest = array_of(eye - eye.astype(dtype), dtype)
    eye, axes, half, near, far = (v if v is None else array_of(v, dtype) for v in (eye, axes, half, near, far))
    return Camera(eye, axes, half, near, far, int(width), int(height), projection, rest)  # type: ignore[arg-type]


def require_up(forward: Any, up: Any) -> None:
    """Raise where no picture has this direction upwards; `forward` is of length 1."""
    up = np.asarray(up, np.float64)
    if up.shape == (3,) and not np.linalg.norm(np.cross(forward, up)) > 1e-9 * np.linalg.norm(up):
        other = tuple(np.eye(3, dtype=int)[np.abs(forward).argmin()].tolist())
        raise ValueError(f"`up` = {up.tolist()} is zero or parallel to the line of sight; choose another, such as {other}")


def _check_view(eye: Any, target: Any, up: Any, near: Any, far: Any, projection: str) -> None:
    for name, vector in (("eye", eye), ("target", target), ("up", up)):
        vector_of(name, vector, "give x, y and z in world space")
    forward = np.asarray(target, np.float64) - np.asarray(eye, np.float64)
    length = np.linalg.norm(forward)
    if length == 0:
        raise ValueError(f"`target` must differ from `eye`, both are {np.asarray(eye).tolist()}; move one of them")
    if not np.isfinite(length):
        raise ValueError(f"`eye` = {np.asarray(eye).tolist()} is too far from `target` for float64; move one of them")
    require_up(forward / length, up)
    given = [float(end) for end in (near, far) if end is not None]
    if not (np.isfinite(given).all() and all(one < other for one, other in itertools.pairwise(given))):
        told = f"got near = {near}, far = {far}; they are depths from the eye"
        raise ValueError(f"`near` must be less than `far`, both finite, {told}")
    if projection == "perspective" and near is not None and float(near) <= 0:
        raise ValueError(f"`near` must be > 0 for a perspective camera, got {near}; samples are spaced geometrically from it")
    if len(given) == 2 and np.float32(near) >= np.float32(far) and not jax.config.read("jax_enable_x64"):
        raise ValueError(f"`near` = {near} and `far` = {far} are the same number in float32; move them apart")
