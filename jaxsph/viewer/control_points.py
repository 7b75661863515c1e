"""What a view looks like: control points that can be dragged, added and removed, and steps back.

Flow: TransferFunction, edits -> [look] -> TransferFunction of as many points, so that no edit compiles anything.

A function with room is padded by its last point: equal neighbours change no picture. Points lie at places 0 to 1 of an axis: that
of the function that the view began with, or one that a norm lays over the same range. A function is linear in Q between its
control points; so that it is linear on the axis of a norm, it has more of them than are shown, at even places.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.model.scene import Scene
from jaxsph.model.transfer.domains import DOMAINS, Scale, control_values
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import POINTS, colormap
from jaxsph.numerics.checks import array_of

ROOMS = (8, 16, 32, 64, 128, 256)
SPARE = 3
"""Points that can be added before there is a larger room, whose programs are compiled once."""
MAX_STEPS = 200
TOP = 4.0
"""Largest extinction of an editor, over the largest that the view began with."""
MAX_STOPS = 10.0
GIVEN = "given"
NORMS = (GIVEN, *DOMAINS)
CLOSE = 0.1  # of the way between even places: a point that is so near to one stands for it
FINE = 4 * (POINTS - 1) + 1  # values that an axis without a formula is known by, those of a map's points among them


@dataclasses.dataclass(frozen=True)
class Point:
    """A control point: place on the axis, extinction per unit length, and colour in [0, 1]."""

    place: float
    extinction: float
    color: tuple[float, float, float]


@dataclasses.dataclass(frozen=True, eq=False)
class ControlPoints:
    """Control points, on an axis.

    Attributes:
        first: the function that the view began with.
        scale: of its values (of those of extinction, where these are others: colours then stay as they are).
        points: ascending by place, at least one; None is the function as it was given.
        capacity: points that there is room for.
        flat: whether they are of colours alone, as those of a surface, which is opaque.
        norm: which laid the scale, one of `NORMS`.
        quantity: values that a norm may need, once it does; None where there are none.
    """

    first: TransferFunction
    scale: Scale
    points: tuple[Point, ...] | None = None
    capacity: int = 0
    flat: bool = False
    norm: str = GIVEN
    quantity: Callable[[], Any] = lambda: None

    @classmethod
    def of(cls, transfer: TransferFunction, *, flat: bool = False, quantity: Callable[[], Any] = lambda: None) -> ControlPoints:
        """That of a function; where it is to be `flat`, of its colours."""
        if flat:
            transfer = dataclasses.replace(transfer, extinction=array_of(np.ones_like(transfer.values)), extinction_values=None)
        room = room_for(len(transfer.extinction) + SPARE)
        return cls(transfer, _scale_of(transfer), None, room, flat, quantity=quantity)

    @property
    def is_split(self) -> bool:
        """Whether extinction has points of its own."""
        return self.first.extinction_values is not None

    @property
    def top(self) -> float:
        """Largest extinction of an editor, per unit length."""
        return TOP * float(np.max(np.asarray(self.first.extinction), initial=0)) or 1.0

    @property
    def shown(self) -> tuple[Point, ...]:
        """The points, also of a function as it was given."""
        if self.points is not None:
            return self.points
        values = np.asarray(self.first.extinction_values if self.is_split else self.first.values, np.float64)
        places = np.clip(np.nan_to_num(self.scale.place(values), neginf=0.0), -1.0, 2.0)
        colors = np.full((len(values), 3), 0.75) if self.is_split else np.asarray(self.first.colors, np.float64)
        extinction = np.asarray(self.first.extinction, np.float64)
        rows = zip(places.tolist(), extinction.tolist(), colors.tolist(), strict=True)
        return tuple(Point(place, opaque, (red, green, blue)) for place, opaque, (red, green, blue) in rows)

    def edited(self, points: list[Point]) -> ControlPoints:
        """With other points, in any order.

        Raises:
            ValueError: none, or more than there is ever room for.
        """
        if not 1 <= len(points) <= ROOMS[-1]:
            raise ValueError(f"a look has 1 to {ROOMS[-1]} control points, got {len(points)}")
        ordered = tuple(sorted(points, key=lambda point: point.place))
        room = room_for(len(ordered) + (POINTS if self._is_bent else 0))
        return dataclasses.replace(self, points=ordered, capacity=max(self.capacity, room))

    def as_given(self) -> ControlPoints:
        """The function that the view began with."""
        return dataclasses.replace(self, points=None, norm=GIVEN, scale=_scale_of(self.first))

    def normed(self, norm: str) -> ControlPoints:
        """At the same places of the axis that a norm lays over the range that the view began with.

        `log` begins at the least positive value where that range does not, and `percentile` has a range of its own.

        Raises:
            ValueError: the norm needs values that there are not, as `log` positive ones.
        """
        if norm == GIVEN:
            scale = _scale_of(self.first)
        else:
            low, high = _scale_of(self.first).value(np.array([0.0, 1.0])).tolist()
            ends = {} if norm == "percentile" else {"high": high} if norm == "log" and low <= 0 else {"low": low, "high": high}
            needed = norm == "equalised" or len(ends) < 2
            values = control_values(norm, self.quantity() if needed else None, points=FINE, **ends)
            name = {"linear": "linear", "percentile": "linear", "log": "log"}.get(norm, "even")
            scale = Scale(name, values if name == "even" else values[[0, -1]])
        return dataclasses.replace(self, norm=norm, scale=scale).edited(list(self.shown))

    def recoloured(self, name: str) -> ControlPoints:
        """With the colours of a map; extinction stays."""
        fine = colormap(name, 256)
        at = np.linspace(0, 1, len(fine))
        made = []
        for point in self.shown:
            red, green, blue = (float(np.interp(point.place, at, channel)) for channel in fine.T)
            made.append(dataclasses.replace(point, color=(red, green, blue)))
        return self.edited(made)

    def exposed(self, stops: float) -> ControlPoints:
        """More, or less, opaque by powers of two."""
        if self.flat:
            raise ValueError("a surface of particles is opaque: it has colours, and nothing to make it thinner or denser by")
        if not abs(stops) <= MAX_STOPS:
            raise ValueError(f"stops must lie within {MAX_STOPS:g}, got {stops:g}")
        return self.edited([dataclasses.replace(point, extinction=point.extinction * 2**stops) for point in self.shown])

    def transfer(self) -> TransferFunction:
        """The function, with room."""
        if self.points is None:
            return self._with_room()
        rows = np.array([(point.place, point.extinction, *point.color) for point in self.points])
        if self._is_bent:
            rows = _with_even_places(rows)
        values = self.scale.value(rows[:, 0])
        if self.is_split:
            return self._with_room(extinction_values=values, extinction=rows[:, 1])
        return self._with_room(values=values, extinction=rows[:, 1], colors=rows[:, 2:])

    @property
    def _is_bent(self) -> bool:
        """Whether a norm laid the axis such that a line on it is none in Q."""
        return self.norm != GIVEN and self.scale.name != "linear"

    def _with_room(self, **given: np.ndarray) -> TransferFunction:
        """The function with those control points; host arrays become the device's once they are of one shape."""
        names = ("extinction_values", "extinction") if self.is_split else ("values", "colors", "extinction")
        padded: dict[str, Any] = {}
        for name in names:
            own = np.asarray(getattr(self.first, name))
            rows = np.asarray(given.get(name, own), own.dtype)
            spare = np.repeat(rows[-1:], max(self.capacity - len(rows), 0), 0)
            padded[name] = array_of(np.concatenate([rows, spare]))
        return dataclasses.replace(self.first, **padded)

    def told(self) -> dict[str, Any]:
        """For the page: points with their values, and the axis."""
        shown = self.shown
        values = self.scale.value(np.array([point.place for point in shown])).tolist()
        rows = [[point.place, point.extinction, *point.color, value] for point, value in zip(shown, values, strict=True)]
        ends = self.scale.value(np.linspace(0, 1, 5)).tolist()
        kind = {"split": self.is_split, "flat": self.flat}
        return {"points": rows, "top": self.top, "scale": self.scale.name, "norm": self.norm, "ticks": ends, **kind}


class Steps:
    """Looks that one can go back to, and forward again."""

    def __init__(self, look: ControlPoints) -> None:
        self.look, self._done, self._undone = look, [look], []  # type: tuple[ControlPoints, list[ControlPoints], list[ControlPoints]]

    def show(self, look: ControlPoints, *, done: bool) -> None:
        """Another look; `done`: a step that one can go back from, which every move of a drag is not."""
        self.look = look
        if done:
            self._done = [*self._done, look][-MAX_STEPS:]
            self._undone.clear()

    def undo(self) -> None:
        """The look before."""
        if len(self._done) > 1:
            self._undone.append(self._done.pop())
        self.look = self._done[-1]

    def redo(self) -> None:
        """The look after."""
        if self._undone:
            self._done.append(self._undone.pop())
            self.look = self._done[-1]


def room_for(points: int) -> int:
    """The smallest room."""
    return next((room for room in ROOMS if room >= points), points)


def _scale_of(transfer: TransferFunction) -> Scale:
    values = transfer.values if transfer.extinction_values is None else transfer.extinction_values
    return Scale.of(np.asarray(values, np.float64))


def _with_even_places(rows: np.ndarray) -> np.ndarray:
    """Rows of place and what is there, with those at even places between the first and the last where no row is close by."""
    places, even = rows[:, 0], np.linspace(0, 1, POINTS)
    far = (np.abs(even[:, None] - places) > CLOSE / (POINTS - 1)).all(1)
    new = even[far & (even > places[0]) & (even < places[-1])]
    more = np.stack([new, *(np.interp(new, places, column) for column in rows[:, 1:].T)], 1)
    found = np.concatenate([rows, more])
    return found[np.argsort(found[:, 0], kind="stable")]


def quantity_of(scene: Scene) -> np.ndarray | None:
    """Values of what is edited, of particles those of extinction where there are two; None of what has none."""
    if scene.transfer is not None and scene.particles is not None:
        return np.asarray(scene.particles.quantities[-1])[np.asarray(scene.particles.valid)]
    return np.asarray(scene.volumes[0][0].values) if scene.volumes else None


def first_look(scene: Scene) -> TransferFunction | None:
    """What is edited of a scene: the look of its particles, else that of its first volume."""
    return scene.looks[0] if scene.looks else None


def is_flat(scene: Scene) -> bool:
    """Whether that is the look of a surface, of which colours are all there is."""
    return scene.surface is not None and scene.transfer is not None


def looking(scene: Scene, transfer: TransferFunction | None) -> Scene:
    """The scene with what is edited in its place."""
    if transfer is None:
        return scene
    if scene.transfer is not None:
        return dataclasses.replace(scene, transfer=transfer)
    looks = scene.volume_transfer
    return dataclasses.replace(scene, volume_transfer=(transfer, *looks[1:]) if isinstance(looks, tuple) else transfer)


def everywhere(scene: Scene) -> Scene:
    """The scene with nothing that its looks hide: what any look may show, to make room for."""

    def seen(transfer: TransferFunction) -> TransferFunction:
        least = 1e-3 * float(np.max(np.asarray(transfer.extinction), initial=0)) or 1e-3
        return dataclasses.replace(transfer, extinction=array_of(np.maximum(transfer.extinction, least)))

    look = first_look(scene)
    return scene if look is None else looking(scene, seen(look))
