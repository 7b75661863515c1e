"""Shapes of clips: a plane, a box and a sphere.

Flow: user -> [clip_shapes] -> clips -> scene.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import corners_of
from jaxsph.model.clips.clips import Clip, Ends, Overlap, Place, Spans, ascending, common, ends_of
from jaxsph.numerics.checks import array_of, at_hand, is_traced, require_finite, require_positive, require_shape
from jaxsph.numerics.extremes import clamped
from jaxsph.numerics.given import plain
from jaxsph.numerics.trees import Placed, fill, left_of, tree, unchecked_of

ROUNDING = 32  # eps of coordinates that a computed distance may be off by: products, their sums, and those of the view


@tree(unchecked=True, init=False)
class Plane(Placed, Clip):
    """What lies on the side of a plane that its normal points to; `~plane` is the other side.

    Attributes:
        point: any of the plane, length units.
        normal: of length 1.
        rest: what rounding a float64 point has left, length units.
    """

    PLACE, REST = "point", "rest"
    point: Float[Array, "3"]
    normal: Float[Array, "3"]
    rest: Float[Array, "3"] = dataclasses.field(init=False)

    def __init__(self, point: Any, normal: Any, *, placed: Any = None):
        """Check and pack; a normal of any length but 0, else `ValueError`, as of other shapes and what is not finite."""
        near, rest = _vector("point", point, placed)
        if is_traced(normal):
            along = normal / jnp.linalg.norm(normal)
        else:
            along, _ = _exact("normal", normal)
            if not along.any():
                raise ValueError("`normal` must not be (0, 0, 0): it tells which side of the plane is shown; give a direction")
            along = along / np.abs(along).max()
            along = along / np.linalg.norm(along)
        fill(self, point=near, normal=array_of(along, near.dtype), rest=rest)

    def seen_by(self, camera: Camera) -> Plane:
        """See `Clip`."""
        point = camera.to_view(self.point, self.rest)
        normal = camera.rotate(self.normal).astype(point.dtype)
        return unchecked_of(Plane, point=point, normal=normal, rest=jnp.zeros_like(point))

    def contains(self, place: Place) -> Bool[Array, "..."]:
        """See `Clip`."""
        return _along(self.normal, place, self.point) >= 0

    def spans(self, begin: Place, end: Place) -> Spans:
        """See `Clip`."""
        return _halves(_along(self.normal, begin, self.point), _along(self.normal, end, self.point))

    def over(self, lower: Place, upper: Place) -> Overlap:
        """See `Clip`."""
        low, high = _heights(self.point, self.normal, lower, upper)
        return Overlap(high >= 0, low >= 0)

    def ends(self, along: np.ndarray, lower: np.ndarray, upper: np.ndarray, inside: bool = True) -> Ends:
        """See `Clip`: of the corners on its side, and of where it cuts edges."""
        corners = corners_of(lower, upper)
        point, normal = (np.asarray(vector, np.float64) for vector in (self.point, self.normal))
        height = (corners - point - np.asarray(self.rest, np.float64)) @ (normal if inside else -normal)
        first, last = np.array([(k, k | bit) for bit in (1, 2, 4) for k in range(8) if not k & bit]).T
        cut = (height[first] >= 0) != (height[last] >= 0)
        first, last = first[cut], last[cut]
        share = (height[first] / (height[first] - height[last]))[:, None]
        crossed = corners[first] + share * (corners[last] - corners[first])
        return ends_of(np.concatenate([corners[height >= 0], crossed]) @ along)


class _Boxed(Clip):
    """What boxes have in common, whose frame is their lower corner, their axes and their sides."""

    @abc.abstractmethod
    def _frame(self) -> tuple[Array, Array, Array]: ...

    def contains(self, place: Place) -> Bool[Array, "..."]:
        origin, axes, sides = self._frame()
        along = [_along(axis, place, origin) for axis in axes]
        x, y, z = ((at >= 0) & (at <= side) for at, side in zip(along, sides, strict=True))
        return x & y & z

    def spans(self, begin: Place, end: Place) -> Spans:
        origin, axes, sides = self._frame()
        first, last = ([_along(axis, place, origin) for axis in axes] for place in (begin, end))
        ways = zip(first, last, sides, strict=True)
        x, y, z = (common(_halves(first, last), _halves(side - first, side - last)) for first, last, side in ways)
        return common(common(x, y), z)

    def over(self, lower: Place, upper: Place) -> Overlap:
        meets: Any = True
        holds: Any = True
        origin, axes, sides = self._frame()
        for axis, side in zip(axes, sides, strict=True):
            low, high = _heights(origin, axis, lower, upper, jnp.abs(side))
            meets, holds = meets & (high >= 0) & (low <= side), holds & (low >= 0) & (high <= side)
        return Overlap(meets, holds)


@tree(unchecked=True, init=False)
class Box(Placed, _Boxed):
    """A box along the axes; `~box` is all but it.

    Attributes:
        lower, upper: corners, length units.
        rest: what rounding float64 corners has left, a row each, length units.
    """

    lower: Float[Array, "3"]
    upper: Float[Array, "3"]
    rest: Float[Array, "2 3"] = dataclasses.field(init=False)
    placed = property(lambda own: tuple(zip((own.lower, own.upper), at_hand(own.rest)[1], strict=True)))

    def __init__(self, lower: Any, upper: Any, *, placed: Any = (None, None)):
        """Check and pack; corners ascend, else `ValueError`, as of other shapes and what is not finite."""
        (low, low_rest), (high, high_rest) = _vector("lower", lower, placed[0]), _vector("upper", upper, placed[1])
        dtype = jnp.promote_types(low.dtype, high.dtype)
        xp, rests = at_hand((low_rest, high_rest))
        fill(self, lower=low.astype(dtype), upper=high.astype(dtype), rest=array_of(xp.stack(rests).astype(dtype)))
        if not is_traced(low, high, self.rest) and not np.less(*self.corners()).all():
            told = " and ".join(str([float(f"{value:.12g}") for value in corner]) for corner in self.corners())
            raise ValueError(f"`lower` must be below `upper` along each axis, got {told}")

    @property
    def sides(self) -> Float[Array, "3"]:
        """Lengths along x, y and z."""
        own: Box = at_hand(self)[1]
        return array_of((own.upper - own.lower) + (own.rest[1] - own.rest[0]))

    def seen_by(self, camera: Camera) -> _TurnedBox:
        """See `Clip`."""
        origin = camera.to_view(self.lower, self.rest[0])
        return _TurnedBox(origin, camera.axes.T.astype(origin.dtype), self.sides.astype(origin.dtype))

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner in float64 (host side)."""
        rest = np.asarray(self.rest, np.float64)
        return np.asarray(self.lower, np.float64) + rest[0], np.asarray(self.upper, np.float64) + rest[1]

    def ends(self, along: np.ndarray, lower: np.ndarray, upper: np.ndarray, inside: bool = True) -> Ends:
        """See `Clip`."""
        if inside:
            low, high = self.corners()
            lower, upper = np.maximum(lower, low), np.minimum(upper, high)
        return super().ends(along, lower, upper) if (lower <= upper).all() else (np.inf, -np.inf)

    def of_dtype(self, dtype: Any) -> Box:
        """The same in float32 or float64 (host side)."""
        return Box(*(corner if dtype == jnp.float64 else corner.tolist() for corner in self.corners()))

    def _frame(self) -> tuple[Array, Array, Array]:
        return self.lower, jnp.eye(3, dtype=self.lower.dtype), self.sides


@tree()
class _TurnedBox(_Boxed):
    """A box along axes of its own.

    Attributes:
        origin: its lower corner, length units.
        axes: rows, orthonormal.
        sides: lengths along those.
    """

    origin: Float[Array, "3"]
    axes: Float[Array, "3 3"]
    sides: Float[Array, "3"]

    def seen_by(self, camera: Camera) -> _TurnedBox:
        turned = jnp.stack([camera.rotate(axis) for axis in self.axes])
        return _TurnedBox(camera.to_view(self.origin), turned, self.sides)

    def _frame(self) -> tuple[Array, Array, Array]:
        return self.origin, self.axes, self.sides


@tree(unchecked=True, init=False)
class Sphere(Placed, Clip):
    """A ball; `~sphere` is all but it.

    Attributes:
        center, radius: length units.
        rest: what rounding a float64 centre has left, length units.
    """

    PLACE, REST = "center", "rest"
    center: Float[Array, "3"]
    radius: Float[Array, ""]
    rest: Float[Array, "3"] = dataclasses.field(init=False)

    def __init__(self, center: Any, radius: Any, *, placed: Any = None):
        """Check and pack; a radius > 0, else `ValueError`, as of other shapes and what is not finite."""
        radius = plain("radius", radius)
        near, rest = _vector("center", center, placed)
        if not is_traced(radius):
            require_shape("radius", radius, (), "give one number")
            require_finite("radius", radius, "give a length")
            require_positive("radius", radius, "give a length")
        fill(self, center=near, radius=array_of(radius, near.dtype), rest=rest)

    def seen_by(self, camera: Camera) -> Sphere:
        """See `Clip`."""
        center = camera.to_view(self.center, self.rest)
        return unchecked_of(Sphere, center=center, radius=self.radius.astype(center.dtype), rest=jnp.zeros_like(center))

    def contains(self, place: Place) -> Bool[Array, "..."]:
        """See `Clip`."""
        return _square([at - own for at, own in zip(place, self.center, strict=True)]) <= self.radius * self.radius

    def spans(self, begin: Place, end: Place) -> Spans:
        """See `Clip`; a chord so short that rounding hides it is none."""
        first = [at - own for at, own in zip(begin, self.center, strict=True)]
        way = [last - own for last, own in zip(end, begin, strict=True)]
        length = _square(way)
        moves = length > 0
        inverse = 1 / jnp.where(moves, length, 1)
        foot = -sum(own * step for own, step in zip(first, way, strict=True)) * inverse
        nearest = _square([own + foot * step for own, step in zip(first, way, strict=True)])
        inner = (self.radius * self.radius - nearest) * inverse
        met = moves & (inner > jnp.finfo(inner.dtype).tiny)
        half = jnp.sqrt(jnp.where(met, inner, 1))
        within = ~moves & (_square(first) <= self.radius * self.radius)
        return _span(jnp.where(met, foot - half, 0), jnp.where(met, foot + half, jnp.where(within, 1, 0)))

    def over(self, lower: Place, upper: Place) -> Overlap:
        """See `Clip`."""
        near, far = [], []
        slack: Any = 0
        for low, high, own in zip(lower, upper, self.center, strict=True):
            near.append(jnp.maximum(jnp.maximum(low - own, own - high), 0))
            far.append(jnp.maximum(high - own, own - low))
            slack = slack + jnp.maximum(jnp.abs(low), jnp.abs(high)) + jnp.abs(own)
        slack = ROUNDING * jnp.finfo(self.radius.dtype).eps * (slack + jnp.abs(self.radius))
        return Overlap(jnp.sqrt(_square(near)) <= self.radius + slack, jnp.sqrt(_square(far)) <= self.radius - slack)

    def ends(self, along: np.ndarray, lower: np.ndarray, upper: np.ndarray, inside: bool = True) -> Ends:
        """See `Clip`: of the box around it, and of the ball."""
        if not inside:
            return super().ends(along, lower, upper)
        radius, center = float(self.radius), np.asarray(self.center, np.float64) + np.asarray(self.rest, np.float64)
        begin, end = Box((center - radius).tolist(), (center + radius).tolist()).ends(along, lower, upper)
        middle = float(center @ along)
        return max(begin, middle - radius), min(end, middle + radius)


def _exact(name: str, value: Any) -> tuple[np.ndarray, Any]:
    """A vector in float64, and the dtype that it is to have."""
    value = plain(name, value)
    given = np.asarray(value)
    if given.shape != (3,):
        raise ValueError(f"`{name}` must have shape (3,), got {given.shape}; give x, y and z")
    exact = given.astype(np.float64)
    require_finite(name, exact, "give x, y and z")
    wide = hasattr(value, "dtype") and jax.dtypes.canonicalize_dtype(given.dtype) == jnp.float64
    return exact, jnp.float64 if wide else jnp.float32


def _vector(name: str, value: Any, placed: tuple[Any, Any] | None = None) -> tuple[Array, Array]:
    """A vector as rounded, and what that has left; of what is as fine as the former, `placed`, as `Placed` has it."""
    if is_traced(value):
        near: Any = jnp.asarray(value)
        rest: Any = jnp.zeros_like(near)
    else:
        exact, dtype = _exact(name, value)
        near = exact.astype(dtype)
        rest = exact - near
    if placed is not None and getattr(value, "dtype", None) == placed[1].dtype:
        rest = left_of(value, placed[1], *placed)
    return array_of(near), array_of(rest, near.dtype)


def _along(axis: Array, place: Place, origin: Array) -> Array:
    """Coordinates of points along an axis, from an origin on."""
    x, y, z = (at - own for at, own in zip(place, origin, strict=True))
    return axis[0] * x + axis[1] * y + axis[2] * z


def _heights(origin: Array, axis: Array, lower: Place, upper: Place, further: Any = 0.0) -> tuple[Array, Array]:
    """The least and the greatest coordinate of boxes along an axis, rounded outwards; `further` is what they are held against."""
    low: Any = 0
    high: Any = 0
    off: Any = further
    for least, most, own, scale in zip(lower, upper, origin, axis, strict=True):
        ends = scale * (least - own), scale * (most - own)
        low, high = low + jnp.minimum(*ends), high + jnp.maximum(*ends)
        off = off + jnp.abs(scale) * (jnp.maximum(jnp.abs(least), jnp.abs(most)) + jnp.abs(own))
    slack = ROUNDING * jnp.finfo(origin.dtype).eps * off
    return low - slack, high + slack


def _square(vector: list[Array]) -> Array:
    return vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]


def _halves(first: Array, last: Array) -> Spans:
    """Where a number that changes evenly from `first` to `last` is at least 0."""
    above, after = first >= 0, last >= 0
    crosses = above != after
    change = jnp.where(crosses, last - first, 1)
    place = clamped(-first / change, 0, 1)
    begin = jnp.where(above, 0, jnp.where(after, place, 1))
    return _span(begin, jnp.where(after, 1, jnp.where(above, place, 1)))


def _span(begin: Array, end: Array) -> Spans:
    return ascending(clamped(begin, 0, 1)[None], clamped(end, 0, 1)[None])
