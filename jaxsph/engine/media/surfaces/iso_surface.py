r"""The surface on which a volume has a given value, as a medium: opaque where a ray first crosses it, shaded by the gradient.

Flow: volume, camera -> [iso-surface: crossing -> normal -> shade] -> integrator.

Each sample stands for a piece of its ray, and the field at both ends of that piece tells whether it crosses the level. Such a
sample lets no light through, so the surface lies in order among all other media, to within a sample. Where it crosses is found by
a few steps of false position (the Illinois form: Dahlquist & Bjoerck 1974, section 6.2), so that shading is smooth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.macrocells import MacrocellRanges, Occupancy
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.volume_grid import VolumeGrid
from jaxsph.model.camera.camera import Camera
from jaxsph.model.medium import Medium
from jaxsph.model.volume import Volume, require_grid
from jaxsph.numerics import faults
from jaxsph.numerics.checks import array_of, is_traced, require_finite, require_positive, require_shape
from jaxsph.numerics.extremes import clamped, greater, ratio
from jaxsph.numerics.trees import tree

OPAQUE = 1e4  # optical thickness of a sample that holds the surface: what other media add to it is nothing
STEPS = 3  # of false position: with them, a crossing in a cubic is off by some 1e-3 of the piece
POLISHED = 2  # steps of Newton's after those: the last has the derivatives, and they are as good as the root before it
Coordinates = list[Float[Array, "tasks samples rays"]]


def headlight(
    normal: Sequence[Float[Array, "..."]],
    ray: Sequence[Float[Array, "..."]],
    ambient: Float[Array, ""],
    light: Float[Array, "3"] | None = None,
) -> Float[Array, "..."]:
    """Ambient light, and the light that a surface faces with the side that is seen (Lambert); where it faces nowhere, all of it.

    Args:
        normal, ray: x, y and z of a vector across the surface and of one along the ray, of any lengths.
        ambient: share of the light that a surface has which is seen edge on.
        light: x, y and z of a vector of unit length towards a light far away; None for a light at the eye.
    """
    along = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    square = square_of(normal) * square_of(ray)
    if light is None:
        facing = jnp.where(square > 0, jnp.abs(along) * lax.rsqrt(jnp.where(square > 0, square, 1)), 1)
        return ambient + (1 - ambient) * facing
    square, towards = square_of(normal), normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
    towards = greater(0, jnp.where(along > 0, -towards, towards))
    return ambient + (1 - ambient) * jnp.where(square > 0, towards * lax.rsqrt(jnp.where(square > 0, square, 1)), 1)


def square_of(vector: Sequence[Float[Array, "..."]]) -> Float[Array, "..."]:
    """Of its length."""
    return vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2


@tree()
class IsoSurface(Medium):
    r"""Where a volume first crosses a level along each ray; make it with `from_volume`.

    Shaded by a light at the eye (Lambert): $c \, (a + (1 - a) \, |n \cdot d|)$, with $d$ the ray's direction, $a$ the share of
    ambient light, and $n$ along the gradient: central differences of the grid, interpolated.

    What is thinner than a sample along a ray can be missed: a piece that enters and leaves between its ends shows no change of
    sign. More samples find it. A box face is no surface: nothing closes the solid where the grid ends.

    Attributes:
        volume: as given; None in view space.
        level: value on the surface, in the units of the volume.
        color: red, green and blue (3,) in [0, 1], where the surface faces the eye.
        ambient: share of the colour that it has where it is seen edge on, in [0, 1].
        grid, holding: the volume in view space, and macrocells that reach the level.
        fault: fault word.
    """

    exact_means = True
    at_points = False  # a surface lies between points, and no step is short enough to resolve it
    may_be_missed = True
    volume: Volume | None
    level: Float[Array, ""]
    color: Float[Array, "3"]
    ambient: Float[Array, ""]
    grid: VolumeGrid | None = None
    holding: Occupancy | None = None
    fault: Int[Array, ""] | None = None

    @classmethod
    def from_volume(cls, volume: Volume, level: Any, color: Any = (0.85, 0.8, 0.7), ambient: Any = 0.15) -> IsoSurface:
        """Check and pack; `ValueError`: a level that is not finite, a colour or a share outside of [0, 1], another shape."""
        if not isinstance(volume, Volume):
            raise ValueError(f"`volume` must be a `jaxsph.Volume`, got {type(volume).__name__}")
        require_grid("`values` of `volume`", volume.shape)
        given = {"level": (level, ()), "color": (color, (3,)), "ambient": (ambient, ())}
        for name, (value, shape) in given.items():
            require_shape(name, value, shape, "give red, green and blue" if shape else "give one number")
            if not is_traced(value):
                require_finite(name, np.asarray(value, np.float64), "give a finite number")
                if name != "level":
                    require_positive(name, value, "it lies in [0, 1]", strict=False)
                    require_positive(f"1 - {name}", 1 - np.asarray(value, np.float64), f"{name} lies in [0, 1]", strict=False)
        packed: dict[str, Any] = {name: array_of(value, volume.dtype) for name, (value, _) in given.items()}
        return cls(volume, **packed)

    def seen_by(self, camera: Camera) -> IsoSurface:
        """In the view space of a camera."""
        if self.volume is None:
            return self
        grid, ranges = VolumeGrid.seen(self.volume, camera), MacrocellRanges.of(self.volume.values)
        level = self.level.astype(grid.origin.dtype)
        usable = ranges.finite() & jnp.isfinite(grid.origin).all() & jnp.isfinite(grid.cells).all() & jnp.isfinite(level)
        fault = faults.raised(faults.BAD_VOLUME, ~usable)
        holding = Occupancy.of(ranges.holding(lax.stop_gradient(level)))
        return dataclasses.replace(self, volume=None, level=level, grid=grid, holding=holding, fault=fault)

    def with_data(self, given: IsoSurface | None) -> IsoSurface:
        """With the values of the volume that it was made of, or without."""
        if self.grid is None or (given is not None and given.volume is None):
            return self
        values = None if given is None or given.volume is None else given.volume.values
        return dataclasses.replace(self, grid=self.grid.holding(values))

    def _viewed(self) -> tuple[VolumeGrid, Occupancy]:
        if self.grid is None or self.holding is None:
            raise ValueError("`IsoSurface` is in world space; ask what `seen_by` made of it")
        return self.grid, self.holding

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that may meet a macrocell which reaches the level."""
        grid, holding = self._viewed()
        return grid.touched(holding, slabs)

    def gather(self, task: SlabTask) -> tuple[Bool[Array, "tasks samples rays"], Float[Array, "tasks 1 rays"]]:
        """Whether the surface is met in what each sample stands for; and how brightly it shines where that is first so in a slab.

        Differentiation:
            Shading has derivatives by values, level and camera: the place where the surface is met is held to be a root of field
            less level, whatever piece of the ray it was found in. Which samples meet it has none: silhouettes do not move.
        """
        grid, _ = self._viewed()
        ends = _ends(task)
        first, last = (grid.coordinates(place) for place in ends)
        enter, leave = lax.stop_gradient(grid.clipped(first, last))
        front, back = _between(first, last, enter), _between(first, last, leave)
        begin, end = (grid.interpolate(place) - self.level for place in (front, back))
        met = (enter < leave) & ((begin >= 0) != (end >= 0))
        pieces = front, back, begin, end, _ray(ends)
        front, back, begin, end, ray = jax.tree.map(lambda of_samples: _first(met, of_samples), pieces)
        share = _crossing(grid, self.level, front, back, begin, end)
        for _ in range(POLISHED):  # of what comes before a step nothing is left in its derivatives, see `_newton`
            share = _newton(grid, self.level, front, back, lax.stop_gradient(share))
        return met, headlight(grid.directions(_gradient(grid, _between(front, back, share))), ray, self.ambient)

    def extinction(self, gathered: tuple[Array, Array], task: SlabTask) -> tuple[Array, Array]:
        """Opaque samples, and how brightly they shine."""
        met, shade = gathered
        length = jnp.sqrt(square_of(lax.stop_gradient(_ray(_ends(task)))))
        return jnp.where(met, ratio(OPAQUE, length), 0), shade

    def colors(self, samples: Array, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """The colour, shaded."""
        return [jnp.broadcast_to(color * samples, task.shape) for color in list(self.color)[channels]]


def _ray(ends: tuple[tuple[Array, ...], tuple[Array, ...]]) -> tuple[Array, ...]:
    """From the beginning to the end of pieces, in view space."""
    return tuple(end - begin for begin, end in zip(*ends, strict=True))


def _first(met: Bool[Array, "tasks samples rays"], of_samples: Array) -> Float[Array, "tasks 1 rays"]:
    """Of the first sample of each slab that meets the surface; of any, where none does. What lies behind is hidden."""
    found = of_samples[:, -1:]
    for k in range(met.shape[1] - 2, -1, -1):
        found = jnp.where(met[:, k : k + 1], of_samples[:, k : k + 1], found)
    return found


def _ends(task: SlabTask) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """View coordinates of where that begins and ends which each sample stands for."""
    border = task.border
    return tuple(dataclasses.replace(task, depth=depth).positions() for depth in (border[:, :-1], border[:, 1:]))  # type: ignore[return-value]


def _between(front: Coordinates, back: Coordinates, share: Array) -> Coordinates:
    return [begin + share * (end - begin) for begin, end in zip(front, back, strict=True)]


def _crossing(grid: VolumeGrid, level: Array, front: Coordinates, back: Coordinates, begin: Array, end: Array) -> Array:
    """Share of each piece that lies in front of the surface, where its ends lie on either side."""

    def step(_: Array, ends: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, at_low, at_high = ends
        share = _secant(low, high, at_low, at_high)
        here = grid.interpolate(_between(front, back, share)) - level
        behind = (here >= 0) == (begin >= 0)  # the surface lies behind
        kept_low, kept_high = jnp.where(behind, at_low, at_low / 2), jnp.where(behind, at_high / 2, at_high)
        return (
            jnp.where(behind, share, low),
            jnp.where(behind, high, share),
            jnp.where(behind, here, kept_low),
            jnp.where(behind, kept_high, here),
        )

    start = jnp.zeros_like(begin), jnp.ones_like(begin), begin, end
    return _secant(*lax.fori_loop(0, STEPS, step, start))


def _newton(grid: VolumeGrid, level: Array, front: Coordinates, back: Coordinates, share: Array) -> Array:
    """A root from one that is near: Newton's step, whose derivatives are those of the root as an implicit function."""

    def field(share: Array) -> Array:
        return grid.interpolate(_between(front, back, share))

    here, slope = jax.jvp(field, (share,), (jnp.ones_like(share),))
    slope = lax.stop_gradient(slope)
    return clamped(share - (here - level) / jnp.where(slope != 0, slope, 1), 0, 1)


def _secant(low: Array, high: Array, at_low: Array, at_high: Array) -> Array:
    change = at_low - at_high
    return low + clamped(jnp.where(change != 0, at_low / jnp.where(change != 0, change, 1), 0.5), 0, 1) * (high - low)


def _gradient(grid: VolumeGrid, place: Coordinates) -> Coordinates:
    """Change a cell along each axis: the interpolant of central differences, which is a difference of interpolants."""
    found = []
    for axis, points in enumerate(grid.values.shape):
        before, behind = jnp.maximum(place[axis] - 1, 0), jnp.minimum(place[axis] + 1, points - 1)
        low, high = ([side if k == axis else at for k, at in enumerate(place)] for side in (before, behind))
        found.append((grid.interpolate(high) - grid.interpolate(low)) / (behind - before))
    return found
