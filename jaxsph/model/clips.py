r"""Clips: parts of space that a scene is shown in: a plane, a box, a sphere, and what is made of two of them.

Flow: user -> [clips] -> scene -> field.within -> cast -> image.

`~clip` is the other side, `a & b` what is in both, `a | b` what is in either. Clips are pytrees of arrays: to move one compiles
nothing anew. Along a line each is a number of *spans*, fixed by how it is put together: one of a plane, a box or a sphere, one
more of the other side, products of both.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.directions import corners_of
from jaxsph.numerics import checks
from jaxsph.numerics.checks import array_of, at_hand, at_once, is_traced, one_number, plain, vector_of
from jaxsph.numerics.compiled import clamped, greater, lesser
from jaxsph.numerics.trees import Placed, fill, left_of, tree, unchecked_of

ROUNDING = 32  # eps of coordinates that a computed distance may be off by: products, their sums, and those of the view
Place = tuple[Float[Array, "..."], ...]  # coordinates x, y and z of points
Ends = tuple[float, float]  # least and greatest coordinate; of nothing they descend


class Spans(NamedTuple):
    """Parts of the way from one point to another, in ascending order, as shares of it; those that are empty come last, at 1."""

    begin: Float[Array, "spans ..."]
    end: Float[Array, "spans ..."]


class Overlap(NamedTuple):
    """Of boxes: whether a clip may have any point in common with each, and whether it is certain to hold all of it."""

    meets: Bool[Array, "..."]
    holds: Bool[Array, "..."]


class Clip(abc.ABC):
    """A part of space; make one of `Plane`, `Box` and `Sphere`."""

    def __invert__(self) -> Clip:
        return Outside(self)

    def __and__(self, other: Clip) -> Clip:
        return Both(self, other) if isinstance(other, Clip) else NotImplemented

    def __or__(self, other: Clip) -> Clip:
        return ~(~self & ~other) if isinstance(other, Clip) else NotImplemented

    @abc.abstractmethod
    def seen_by(self, camera: Camera) -> Clip:
        """The same in view space."""

    @abc.abstractmethod
    def contains(self, place: Place) -> Bool[Array, "..."]:
        """Whether points are in it."""

    @abc.abstractmethod
    def spans(self, begin: Place, end: Place) -> Spans:
        """What of the ways from points to others is in it."""

    @abc.abstractmethod
    def over(self, lower: Place, upper: Place) -> Overlap:
        """Which boxes it meets, and which it holds: both are right whatever is rounded here and in `contains`."""

    def ends(self, along: np.ndarray, lower: np.ndarray, upper: np.ndarray, inside: bool = True) -> Ends:
        """Between which coordinates along a direction lies what of a box is in it, or is not `inside`; at most (host side)."""
        return ends_of(corners_of(lower, upper) @ along)


@tree()
class Outside(Clip):
    """The other side of a clip: `~clip`."""

    clip: Clip

    def seen_by(self, camera: Camera) -> Outside:
        """See `Clip`."""
        return Outside(self.clip.seen_by(camera))

    def contains(self, place: Place) -> Bool[Array, "..."]:
        """See `Clip`."""
        return ~self.clip.contains(place)

    def spans(self, begin: Place, end: Place) -> Spans:
        """See `Clip`: what lies between the spans of the other side, and beside them."""
        inner = self.clip.spans(begin, end)
        edge = jnp.ones_like(inner.begin[:1])
        return ascending(jnp.concatenate([0 * edge, inner.end]), jnp.concatenate([inner.begin, edge]))

    def over(self, lower: Place, upper: Place) -> Overlap:
        """See `Clip`."""
        inner = self.clip.over(lower, upper)
        return Overlap(~inner.holds, ~inner.meets)

    def ends(self, along: np.ndarray, lower: np.ndarray, upper: np.ndarray, inside: bool = True) -> Ends:
        """See `Clip`."""
        return self.clip.ends(along, lower, upper, not inside)


@tree()
class Both(Clip):
    """What is in both of two clips: `first & second`."""

    first: Clip
    second: Clip

    def seen_by(self, camera: Camera) -> Both:
        """See `Clip`."""
        return Both(self.first.seen_by(camera), self.second.seen_by(camera))

    def contains(self, place: Place) -> Bool[Array, "..."]:
        """See `Clip`."""
        return self.first.contains(place) & self.second.contains(place)

    def spans(self, begin: Place, end: Place) -> Spans:
        """See `Clip`."""
        return common(self.first.spans(begin, end), self.second.spans(begin, end))

    def over(self, lower: Place, upper: Place) -> Overlap:
        """See `Clip`."""
        first, second = self.first.over(lower, upper), self.second.over(lower, upper)
        return Overlap(first.meets & second.meets, first.holds & second.holds)

    def ends(self, along: np.ndarray, lower: np.ndarray, upper: np.ndarray, inside: bool = True) -> Ends:
        """See `Clip`."""
        begins, ends = zip(*(one.ends(along, lower, upper, inside) for one in (self.first, self.second)), strict=True)
        return (max(begins), min(ends)) if inside else (min(begins), max(ends))


class _BetweenPlanes(Clip):
    """What lies between planes across axes: from an origin on, as far as a side, or on and on where that is None."""

    @abc.abstractmethod
    def _frame(self) -> tuple[Array, Any, Any]:
        """Origin, axes and sides."""

    def contains(self, place: Place) -> Bool[Array, "..."]:
        origin, axes, sides = self._frame()
        found = [(_along(axis, place, origin), side) for axis, side in zip(axes, sides, strict=True)]
        return functools.reduce(operator.and_, [at >= 0 if side is None else (at >= 0) & (at <= side) for at, side in found])

    def spans(self, begin: Place, end: Place) -> Spans:
        (origin, axes, sides), found = self._frame(), []
        for axis, side in zip(axes, sides, strict=True):
            first, last = (_along(axis, place, origin) for place in (begin, end))
            beyond = _halves(first, last)
            found.append(beyond if side is None else common(beyond, _halves(side - first, side - last)))
        return functools.reduce(common, found)

    def over(self, lower: Place, upper: Place) -> Overlap:
        meets: Any = True
        holds: Any = True
        origin, axes, sides = self._frame()
        for axis, side in zip(axes, sides, strict=True):
            low, high = heights(origin, axis, lower, upper, 0.0 if side is None else jnp.abs(side))
            meets, holds = meets & (high >= 0), holds & (low >= 0)
            if side is not None:
                meets, holds = meets & (low <= side), holds & (high <= side)
        return Overlap(meets, holds)


@tree(unchecked=True, init=False)
class Plane(Placed, _BetweenPlanes):
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
            along = vector_of("normal", normal)
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

    def _frame(self) -> tuple[Array, Any, Any]:
        return self.point, (self.normal,), (None,)

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


@tree(unchecked=True, init=False)
class Box(Placed, _BetweenPlanes):
    """A box along the axes; `~box` is all but it.

    Attributes:
        lower, upper: corners, length units.
        rest: what rounding float64 corners has left, a row each, length units.
    """

    lower: Float[Array, "3"]
    upper: Float[Array, "3"]
    rest: Float[Array, "2 3"] = dataclasses.field(init=False)

    def __init__(self, lower: Any, upper: Any, *, placed: Any = (None, None)):
        """Check and pack; corners ascend, else `ValueError`, as of other shapes and what is not finite."""
        (low, low_rest), (high, high_rest) = _vector("lower", lower, placed[0]), _vector("upper", upper, placed[1])
        dtype = jnp.promote_types(low.dtype, high.dtype)
        with at_once(low, high, low_rest, high_rest):
            xp, rests = at_hand((low_rest, high_rest))
            fill(self, lower=low.astype(dtype), upper=high.astype(dtype), rest=array_of(xp.stack(rests).astype(dtype)))
        if not is_traced(low, high, self.rest) and not np.less(*self.corners()).all():
            told = " and ".join(str([float(f"{value:.12g}") for value in corner]) for corner in self.corners())
            raise ValueError(f"`lower` must be below `upper` along each axis, got {told}")

    @property  # type: ignore[misc]
    def placed(self) -> tuple[Any, ...]:
        """Corners, each with what rounding has left of it: see `Placed`."""
        with at_once(self):
            return tuple(zip((self.lower, self.upper), at_hand(self.rest)[1], strict=True))

    @property
    def sides(self) -> Float[Array, "3"]:
        """Lengths along x, y and z."""
        with at_once(self):
            own: Box = at_hand(self)[1]
            return array_of((own.upper - own.lower) + (own.rest[1] - own.rest[0]))

    def seen_by(self, camera: Camera) -> _TurnedBox:
        """See `Clip`."""
        origin = camera.to_view(self.lower, self.rest[0])
        return _TurnedBox(origin, camera.axes.T.astype(origin.dtype), self.sides.astype(origin.dtype))

    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner in float64 (host side)."""
        rest = np.asarray(self.rest, np.float64)
        return _exact(self.lower, rest[0]), _exact(self.upper, rest[1])

    def ends(self, along: np.ndarray, lower: np.ndarray, upper: np.ndarray, inside: bool = True) -> Ends:
        """See `Clip`."""
        if inside:
            low, high = self.corners()
            lower, upper = np.maximum(lower, low), np.minimum(upper, high)
        return super().ends(along, lower, upper) if (lower <= upper).all() else (np.inf, -np.inf)

    def of_dtype(self, dtype: Any) -> Box:
        """The same in float32 or float64 (host side)."""
        return Box(*(corner if dtype == jnp.float64 else corner.tolist() for corner in self.corners()))

    def _frame(self) -> tuple[Array, Any, Any]:
        return self.lower, jnp.eye(3, dtype=self.lower.dtype), self.sides


@tree()
class _TurnedBox(_BetweenPlanes):
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

    def _frame(self) -> tuple[Array, Any, Any]:
        return self.origin, self.axes, self.sides


@tree(unchecked=True, init=False, static=("of_width",))
class Sphere(Placed, Clip):
    """A ball; `~sphere` is all but it.

    Attributes:
        center, radius: length units.
        of_width: whether it is what a picture's width leaves of a scene, and columns go on beyond.
        rest: what rounding a float64 centre has left, length units.
    """

    PLACE, REST = "center", "rest"
    center: Float[Array, "3"]
    radius: Float[Array, ""]
    of_width: bool = False
    rest: Float[Array, "3"] = dataclasses.field(init=False)

    def __init__(self, center: Any, radius: Any, of_width: bool = False, *, placed: Any = None):
        """Check and pack; a radius > 0, else `ValueError`, as of other shapes and what is not finite."""
        radius = one_number("radius", radius)
        near, rest = _vector("center", center, placed)
        if not is_traced(radius):
            checks.require_finite("radius", radius, "give a length")
            checks.require_positive("radius", radius, "give a length")
        fill(self, center=near, radius=array_of(radius, near.dtype), of_width=of_width, rest=rest)

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


def ends_of(coordinates: np.ndarray) -> Ends:
    """Of points."""
    return float(coordinates.min(initial=np.inf)), float(coordinates.max(initial=-np.inf))


def inside(clip: Clip | None, place: Float[np.ndarray, "... 3"]) -> Bool[np.ndarray, "..."]:
    """Whether points in world space are in a clip, in float64 (host side); None is everywhere."""
    if clip is None:
        return np.ones(place.shape[:-1], bool)
    if isinstance(clip, Outside):
        return ~inside(clip.clip, place)
    if isinstance(clip, Both):
        return inside(clip.first, place) & inside(clip.second, place)
    if isinstance(clip, Plane):
        return (place - _exact(clip.point, clip.rest)) @ np.asarray(clip.normal, np.float64) >= 0
    if isinstance(clip, Sphere):
        return ((place - _exact(clip.center, clip.rest)) ** 2).sum(-1) <= float(clip.radius) ** 2
    if isinstance(clip, Box):
        lower, upper = clip.corners()
        return np.asarray(np.all((place >= lower) & (place <= upper), axis=-1))
    raise ValueError(f"a clip must be made of planes, boxes and spheres, got a `{type(clip).__name__}`")


def _exact(near: Any, rest: Any) -> np.ndarray:
    return np.asarray(near, np.float64) + np.asarray(rest, np.float64)


def both(first: Clip | None, second: Clip | None) -> Clip | None:
    """What is in both, where None is everywhere."""
    if first is None or second is None:
        return second if first is None else first
    return first & second


def common(first: Spans, second: Spans) -> Spans:
    """What is in both: spans of one are apart, so pairs of them are."""
    begin = greater(first.begin[:, None], second.begin[None])
    end = lesser(first.end[:, None], second.end[None])
    shape = -1, *begin.shape[2:]
    return ascending(begin.reshape(shape), end.reshape(shape))


def ascending(begin: Array, end: Array) -> Spans:
    """Spans that are apart, in order: begins and ends may be sorted each for itself."""
    filled = end > begin
    begin, end = jnp.where(filled, begin, 1), jnp.where(filled, end, 1)
    return Spans(_sorted(begin), _sorted(end))


def _sorted(values: Array) -> Array:
    """Ascending along the first axis, of few: by neighbours that change places, as often as there are values.

    Not by `jnp.sort`, whose cotangents XLA's CPU compiler gets wrong among others that it optimises together with them.
    """
    rows = list(values)
    for turn in range(len(rows)):
        for k in range(turn % 2, len(rows) - 1, 2):
            swapped = rows[k] > rows[k + 1]
            pair = rows[k : k + 2]
            rows[k : k + 2] = jnp.where(swapped, pair[1], pair[0]), jnp.where(swapped, pair[0], pair[1])
    return jnp.stack(rows)


def _vector(name: str, value: Any, placed: tuple[Any, Any] | None) -> tuple[Array, Array]:
    """A vector as rounded, and what that has left; of what is as fine as the former, `placed`, as `Placed` has it."""
    if is_traced(value):
        near: Any = jnp.asarray(value)
        rest: Any = jnp.zeros_like(near)
    else:
        value = plain(name, value)
        exact = vector_of(name, value)
        wide = hasattr(value, "dtype") and jax.dtypes.canonicalize_dtype(value.dtype) == jnp.float64
        near = exact.astype(jnp.float64 if wide else jnp.float32)
        rest = exact - near
    if placed is not None and getattr(value, "dtype", None) == placed[1].dtype:
        rest = left_of(value, placed[1], *placed)
    return array_of(near), array_of(rest, near.dtype)


def _along(axis: Array, place: Place, origin: Array) -> Array:
    """Coordinates of points along an axis, from an origin on."""
    x, y, z = (at - own for at, own in zip(place, origin, strict=True))
    return axis[0] * x + axis[1] * y + axis[2] * z


def heights(origin: Array, axis: Array, lower: Place, upper: Place, further: Any = 0.0) -> tuple[Array, Array]:
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
