r"""The surface on which a volume has a given value, as a medium: opaque where a ray first crosses it, shaded by the gradient.

Flow: volume, camera -> [iso-surface: crossing -> normal -> shade] -> integrator.

Each sample stands for a piece of its ray, and the field at both ends of that piece tells whether it crosses the level. Such a
sample lets no light through, so the surface lies in order among all other media, to within a sample. Where it crosses is found by
a few steps of false position (the Illinois form: Dahlquist & Bjoerck 1974, section 6.2), so that shading is smooth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.volume_grid import MacrocellRanges, VolumeGrid, counted
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.surfaces.crossing import newton, secant
from jaxsph.model.camera.camera import Camera
from jaxsph.model.medium import Medium
from jaxsph.model.scene import require_looks
from jaxsph.model.volume import Volume, require_grid
from jaxsph.numerics import faults
from jaxsph.numerics.checks import array_of
from jaxsph.numerics.compiled import clamped, ratio
from jaxsph.numerics.trees import tree

OPAQUE = 1e4  # optical thickness of a sample that holds the surface: what other media add to it is nothing
STEPS = 3  # of false position: with them, a crossing in a cubic is off by some 1e-3 of the piece
POLISHED = 2  # steps of Newton's after those: the last has the derivatives, and they are as good as the root before it
Coordinates = list[Float[Array, "tasks samples rays"]]
Vector = Sequence[Float[Array, "..."]]


def dot(one: Vector, other: Vector) -> Float[Array, "..."]:
    """Of x, y and z of vectors."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def headlight(normal: Vector, ray: Vector, ambient: Float[Array, ""]) -> Float[Array, "..."]:
    """Ambient light, and that from the eye, which a surface faces (Lambert); where it faces nowhere, all of it.

    Args:
        normal, ray: x, y and z of a vector across the surface and of one along the ray, of any lengths.
        ambient: share of the light that a surface has which is seen edge on.
    """
    along, square = jnp.abs(dot(normal, ray)), dot(normal, normal) * dot(ray, ray)
    return ambient + (1 - ambient) * jnp.where(square > 0, along * lax.rsqrt(jnp.where(square > 0, square, 1)), 1)


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
        grid, holding: the volume in view space, and macrocells that reach the level, `counted`.
        fault: fault word.
    """

    exact_means = True
    may_be_missed = True
    LENGTHS: ClassVar[dict[str, int]] = {"volume": 0}  # a part that has lengths, see `engine.request`
    volume: Volume | None
    level: Float[Array, ""]
    color: Float[Array, "3"]
    ambient: Float[Array, ""]
    grid: VolumeGrid | None = None
    holding: Int[Array, "bx_and_one by_and_one bz_and_one"] | None = None
    fault: Int[Array, ""] | None = None

    @classmethod
    def from_volume(cls, volume: Volume, level: Any, color: Any = (0.85, 0.8, 0.7), ambient: Any = 0.15) -> IsoSurface:
        """Check and pack; `ValueError`: a level that is not finite, a colour or a share outside of [0, 1], another shape."""
        if not isinstance(volume, Volume):
            raise ValueError(f"`volume` must be a `jaxsph.Volume`, got {type(volume).__name__}")
        require_grid("`values` of `volume`", volume.shape)
        require_looks(level=level, color=color, ambient=ambient)
        level, color, ambient = (array_of(value, volume.dtype) for value in (level, color, ambient))
        return cls(volume, level, color, ambient)

    def seen_by(self, camera: Camera) -> IsoSurface:
        """In the view space of a camera."""
        if self.volume is None:
            return self
        grid, ranges = VolumeGrid.seen(self.volume, camera), MacrocellRanges.of(self.volume.values)
        level = self.level.astype(grid.origin.dtype)
        usable = ranges.finite() & jnp.isfinite(grid.origin).all() & jnp.isfinite(grid.cells).all() & jnp.isfinite(level)
        fault = faults.raised(faults.BAD_VOLUME, ~usable)
        holding = counted(ranges.holding(lax.stop_gradient(level)))
        return dataclasses.replace(self, volume=None, level=level, grid=grid, holding=holding, fault=fault)

    def with_data(self, given: IsoSurface | None) -> IsoSurface:
        """With the values of the volume that it was made of, or without."""
        if self.grid is None or (given is not None and given.volume is None):
            return self
        values = None if given is None or given.volume is None else given.volume.values
        return dataclasses.replace(self, grid=self.grid.holding(values))

    def _viewed(self) -> tuple[VolumeGrid, Int[Array, "bx_and_one by_and_one bz_and_one"]]:
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
        grid, at = self._viewed()[0], task.on_borders().positions()
        ray = _along(at)
        first, last = ([of[:, ends] for of in grid.coordinates(at)] for ends in (slice(-1), slice(1, None)))
        enter, leave = lax.stop_gradient(grid.clipped(first, last))
        front, back = _between(first, last, enter), _between(first, last, leave)
        begin, end = (grid.interpolate(place) - self.level for place in (front, back))
        met = (enter < leave) & ((begin >= 0) != (end >= 0)) & ~jnp.isnan(begin + end)  # NaN is not there, and no side
        pieces = front, back, begin, end, ray
        front, back, begin, end, ray = jax.tree.map(lambda of_samples: _first(met, of_samples), pieces)

        def field(share: Array) -> Array:
            off = grid.interpolate(_between(front, back, share)) - self.level
            return jnp.where(jnp.isnan(off), 0, off)

        share = _crossing(field, begin, end)
        for _ in range(POLISHED):  # of what comes before a step nothing is left in its derivatives: those of an implicit function
            share = lax.stop_gradient(share)
            off, slope = jax.jvp(field, (share,), (jnp.ones_like(share),))
            share = clamped(newton(share, off, lax.stop_gradient(slope)), 0, 1)
        return met, headlight(grid.directions(_gradient(grid, _between(front, back, share))), ray, self.ambient)

    def extinction(self, gathered: tuple[Array, Array], task: SlabTask) -> tuple[Array, Array]:
        """Opaque samples, and how brightly they shine."""
        met, shade = gathered
        ray = lax.stop_gradient(_along(task.on_borders().positions()))
        return jnp.where(met, ratio(OPAQUE, jnp.sqrt(dot(ray, ray))), 0), shade

    def colors(self, samples: Array, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """The colour, shaded."""
        return [jnp.broadcast_to(color * samples, task.shape) for color in list(self.color)[channels]]


def _along(borders: tuple[Array, ...]) -> Coordinates:
    """From each border to the next."""
    return [of[:, 1:] - of[:, :-1] for of in borders]


def _first(met: Bool[Array, "tasks samples rays"], of_samples: Array) -> Float[Array, "tasks 1 rays"]:
    """Of the first sample of each slab that meets the surface; of any, where none does. What lies behind is hidden."""
    found = of_samples[:, -1:]
    for k in range(met.shape[1] - 2, -1, -1):
        found = jnp.where(met[:, k : k + 1], of_samples[:, k : k + 1], found)
    return found


def _between(front: Coordinates, back: Coordinates, share: Array) -> Coordinates:
    return [begin + share * (end - begin) for begin, end in zip(front, back, strict=True)]


def _crossing(field: Callable[[Array], Array], begin: Array, end: Array) -> Array:
    """Share of each piece that lies in front of the surface, where its ends lie on either side."""

    def step(_: Array, ends: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, at_low, at_high = ends
        share = secant(low, high, at_low, at_high)
        here = field(share)
        behind = (here >= 0) == (begin >= 0)  # the surface lies behind
        low, high = jnp.where(behind, share, low), jnp.where(behind, high, share)
        return low, high, jnp.where(behind, here, at_low / 2), jnp.where(behind, at_high / 2, here)

    start = jnp.zeros_like(begin), jnp.ones_like(begin), begin, end
    return secant(*lax.fori_loop(0, STEPS, step, start))


def _gradient(grid: VolumeGrid, place: Coordinates) -> Coordinates:
    """Change a cell along each axis: the interpolant of central differences, which is a difference of interpolants.

    It is one-sided where nothing is on one side.
    """
    found, here = [], jnp.nan_to_num(grid.interpolate(place))
    for axis, points in enumerate(grid.values.shape):
        before, behind = jnp.maximum(place[axis] - 1, 0), jnp.minimum(place[axis] + 1, points - 1)
        low, high = ([side if k == axis else at for k, at in enumerate(place)] for side in (before, behind))
        ends = grid.interpolate(low), grid.interpolate(high)
        before, behind = (jnp.where(jnp.isnan(end), place[axis], at) for end, at in zip(ends, (before, behind), strict=True))
        least, most = (jnp.where(jnp.isnan(end), here, end) for end in ends)
        found.append((most - least) / jnp.where(behind > before, behind - before, 1))
    return found
