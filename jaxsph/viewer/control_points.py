"""What a view looks like: control points that can be dragged, added and removed, and steps back.

Flow: TransferFunction, edits -> [look] -> TransferFunction of as many points, so that no edit compiles anything.

A function with room is padded by its last point: equal neighbours change no picture. Points lie at places 0 to 1 of the axis
of the function that the view began with.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import Scale, colormap, colors_at
from jaxsph.numerics.checks import array_of

ROOMS = (8, 16, 32, 64, 128, 256)
SPARE = 3
"""Points that can be added before there is a larger room, whose programs are compiled once."""
TOP = 4.0
"""Largest extinction of an editor, over the largest that the view began with."""


@dataclasses.dataclass(frozen=True, eq=False)
class ControlPoints:
    """Control points, on an axis.

    Attributes:
        first: the function that the view began with.
        scale: of its values (of those of extinction, where these are others: colours then stay as they are).
        points: (N, 5) rows of place, extinction per unit length, red, green and blue in [0, 1], ascending by place, at least one;
            None is the function as it was given.
        capacity: points that there is room for.
        flat: whether they are of colours alone, as those of a surface, which is opaque.
    """

    first: TransferFunction
    scale: Scale
    points: np.ndarray | None = None
    capacity: int = 0
    flat: bool = False

    @classmethod
    def of(cls, transfer: TransferFunction, *, flat: bool = False) -> ControlPoints:
        """That of a function; where it is to be `flat`, of its colours."""
        if flat:
            transfer = dataclasses.replace(transfer, extinction=array_of(np.ones_like(transfer.values)), extinction_values=None)
        values = transfer.values if transfer.extinction_values is None else transfer.extinction_values
        room = room_for(len(transfer.extinction) + SPARE)
        return cls(transfer, Scale.of(np.asarray(values, np.float64)), None, room, flat)

    @property
    def is_split(self) -> bool:
        """Whether extinction has points of its own."""
        return self.first.extinction_values is not None

    @property
    def shown(self) -> np.ndarray:
        """The points, also of a function as it was given."""
        if self.points is not None:
            return self.points
        values = np.asarray(self.first.extinction_values if self.is_split else self.first.values, np.float64)
        places = np.clip(np.nan_to_num(self.scale.place(values), neginf=0.0), -1.0, 2.0)
        colors = np.full((len(values), 3), 0.75) if self.is_split else self.first.colors
        return np.column_stack([places, np.asarray(self.first.extinction, np.float64), np.asarray(colors, np.float64)])

    def edited(self, points: np.ndarray) -> ControlPoints:
        """With other points, in any order.

        Raises:
            ValueError: none, or more than there is ever room for.
        """
        if not 1 <= len(points) <= ROOMS[-1]:
            raise ValueError(f"a look has 1 to {ROOMS[-1]} control points, got {len(points)}")
        ordered = points[np.argsort(points[:, 0], kind="stable")]
        return dataclasses.replace(self, points=ordered, capacity=max(self.capacity, room_for(len(ordered))))

    def recoloured(self, name: str) -> ControlPoints:
        """With the colours of a map; extinction stays."""
        points, fine = self.shown.copy(), colormap(name, 256)
        points[:, 2:] = colors_at(points[:, 0], np.linspace(0, 1, len(fine)), fine)
        return self.edited(points)

    def exposed(self, stops: float) -> ControlPoints:
        """More, or less, opaque by powers of two."""
        if self.flat:
            raise ValueError("a surface of particles is opaque: it has colours, and nothing to make it thinner or denser by")
        return self.edited(self.shown * (1, 2**stops, 1, 1, 1))

    @functools.cached_property
    def transfer(self) -> TransferFunction:
        """The function, with room; host arrays become the device's once they are of one shape."""
        given: dict[str, np.ndarray] = {}
        if self.points is not None:
            values = self.scale.value(self.points[:, 0])
            given = {"extinction_values" if self.is_split else "values": values, "extinction": self.points[:, 1]}
            given |= {} if self.is_split else {"colors": self.points[:, 2:]}
        padded: dict[str, Any] = {}
        for name in ("extinction_values", "extinction") if self.is_split else ("values", "colors", "extinction"):
            own = np.asarray(getattr(self.first, name))
            rows = np.asarray(given.get(name, own), own.dtype)
            padded[name] = array_of(np.concatenate([rows, np.repeat(rows[-1:], max(self.capacity - len(rows), 0), 0)]))
        return dataclasses.replace(self.first, **padded)

    def told(self) -> dict[str, Any]:
        """For the page: points with their values, the largest extinction of an editor, and the axis."""
        rows = np.column_stack([self.shown, self.scale.value(self.shown[:, 0])]).tolist()
        top = TOP * float(np.max(np.asarray(self.first.extinction), initial=0)) or 1.0
        axis = {"scale": self.scale.name, "ticks": self.scale.value(np.linspace(0, 1, 5)).tolist()}
        return {"points": rows, "top": top, **axis, "split": self.is_split, "flat": self.flat}


def room_for(points: int) -> int:
    """The smallest room."""
    return next((room for room in ROOMS if room >= points), points)


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
    if (look := first_look(scene)) is None:
        return scene
    least = 1e-3 * float(np.max(np.asarray(look.extinction), initial=0)) or 1e-3
    return looking(scene, dataclasses.replace(look, extinction=array_of(np.maximum(look.extinction, least))))
