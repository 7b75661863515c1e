r"""Clips: parts of space that a scene is shown in, and what is made of two of them.

Flow: clip_shapes -> [clips] -> scene -> field.within -> cast -> image.

`~clip` is the other side, `a & b` what is in both, `a | b` what is in either. Clips are pytrees of arrays: to move one compiles
nothing anew. Along a line each is a number of *spans*, fixed by how it is put together: one of a plane, a box or a sphere, one
more of the other side, products of both.
"""

from __future__ import annotations

import abc
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import corners_of
from jaxsph.numerics.extremes import greater, lesser
from jaxsph.numerics.trees import tree

Place = tuple[Float[Array, "..."], ...]
"""Coordinates x, y and z of points."""
Ends = tuple[float, float]
"""Least and greatest coordinate; of nothing they descend."""


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


def ends_of(coordinates: np.ndarray) -> Ends:
    """Of points."""
    return float(coordinates.min(initial=np.inf)), float(coordinates.max(initial=-np.inf))


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
