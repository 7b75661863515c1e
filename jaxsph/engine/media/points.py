r"""Points as a medium: each sample has the integral of their extinction from border to border, and their colours by extinction.

Flow: points, camera, lists -> [points: chords -> sums] -> integrator; cotangents -> [points: by jax.vjp, block by block].

The ray of unit direction d passes the centre c of a point at the distance b, at the foot of c on it. With t counted from there
in radii r, a sample from $t_0$ to $t_1$ has the optical thickness $\xi r \int_{t_0}^{t_1} f(\sqrt{b^2 + t^2}) dt$: nothing is
sampled, so no point is missed however small, and "the step length is that of the smallest point" (Kaehler, Abel & Hege 2007,
section 3.2) for each by itself. Their projection has all of it at the foot, a splat all of it at the depth of the centre; see
`model.points`. Shapes, once: (tasks, points of a block, samples of a slab, rays).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.field.fetch import particle_at
from jaxsph.engine.field.sums import Sums, sums_of
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.camera.camera import Camera
from jaxsph.model.medium import Medium, OfPlaces
from jaxsph.model.points import Points
from jaxsph.model.profiles import Chord, Profile, Shaped
from jaxsph.numerics import faults
from jaxsph.numerics.extremes import clamped, ratio
from jaxsph.numerics.fusion import fusion_barrier
from jaxsph.numerics.trees import tree

NUM_COLUMNS = 8  # of a row of the table: read, and added to, as one
BLOCK = 4  # points whose chords are held at once
PARTS = 4, 16  # of the slabs of a task that have loops of their own: points are clustered


class Row(NamedTuple):
    """Points in view space, as columns.

    Attributes:
        x, y, z: of the centre, length units.
        inverse: of the radius.
        strength: extinction times radius: the thickness of a chord of length 1 in radii.
        red, green, blue: in [0, 1].
    """

    x: Array
    y: Array
    z: Array
    inverse: Array
    strength: Array
    red: Array
    green: Array
    blue: Array


class PointRays(NamedTuple):
    """Rays of tasks, one by one.

    Attributes:
        u, v: ray coordinates.
        border: depths of the borders of samples.
        slant: path length a unit of depth.
        axes: of the camera.
    """

    u: Float[Array, "tasks rays"]
    v: Float[Array, "tasks rays"]
    border: Float[Array, "tasks samples_and_one 1"]
    slant: Float[Array, "tasks rays"]
    axes: Float[Array, "3 3"]
    perspective: bool

    @classmethod
    def of(cls, task: SlabTask, axes: Array) -> PointRays:
        """Of the slabs of a task."""
        u, v = task.ray_coordinates()
        slant = jnp.sqrt(1 + u * u + v * v) if task.perspective else jnp.ones_like(u)
        return cls(u, v, task.border[..., None], slant, axes, task.perspective)

    def nearest(self, row: Row) -> tuple[Array, list[Array]]:
        """Depth of the foot of centres on rays, (tasks, points, rays), and the offset of it from the centre."""
        u, v = self.u[:, None], self.v[:, None]
        if not self.perspective:
            foot = jnp.broadcast_to(row.z, (*row.z.shape[:2], u.shape[2]))
            return foot, [u - row.x, v - row.y, jnp.zeros_like(foot)]
        # from the depth of the centre on: what is small is not the difference of what is large
        x, y = row.x - u * row.z, row.y - v * row.z
        further = (x * u + y * v) / (self.slant[:, None] ** 2)
        return row.z + further, [u * further - x, v * further - y, further]

    def direction_in_world(self) -> list[Array]:
        """Of length 1, (tasks, rays)."""
        ahead = jnp.ones_like(self.u)
        if not self.perspective:
            return self.in_world([jnp.zeros_like(self.u), jnp.zeros_like(self.u), ahead])
        return self.in_world([part / self.slant for part in (self.u, self.v, ahead)])

    def in_world(self, view: list[Array]) -> list[Array]:
        """Directions of view space along the axes of the world."""
        return [sum(self.axes[k, axis] * view[k] for k in range(3)) for axis in range(3)]  # type: ignore[misc]


class Listed(NamedTuple):
    """Of a band: spheres by rank in the lists of bundles, their numbers in the scene, and the depths of borders."""

    rank: Int[Array, " pairs"]
    number: Int[Array, " spheres"]
    border: Float[Array, " samples_and_one"]


@tree(static=("first", "spread"))
class PointsMedium(Medium):
    """A point set in view space.

    Attributes:
        table: `Row` of each point.
        attributes: of points, by name.
        axes: of the camera, rows: for profiles that are not radial.
        splat: which are splats; None where none are.
        profile, spread: see `Points`.
        fault: fault word.
        lists: of a band.
        first: number of the first point among all spheres of the scene.
    """

    at_points = False  # lists are of slabs, and what is found is of what lies between borders
    between_samples = True
    exact_means = True
    table: Float[Array, "points 8"]
    attributes: dict[str, Float[Array, " points"]]
    axes: Float[Array, "3 3"]
    splat: Bool[Array, " points"] | None
    profile: Profile
    fault: Int[Array, ""]
    lists: Listed | None
    first: int
    spread: str

    @classmethod
    def seen(cls, points: Points, camera: Camera, first: int) -> PointsMedium:
        """As a camera sees them.

        Differentiation:
            By all numbers of the points, and by the camera. Which are splats is held fixed.
        """
        dtype = jnp.promote_types(points.dtype, camera.dtype)
        offset = camera.offset(points.position, points.position_rest)
        view = camera.rotate(offset).astype(dtype)
        usable = points.usable()
        radius = jnp.where(usable, points.radius, 1).astype(dtype)
        strength = jnp.where(usable, points.extinction, 0).astype(dtype) * radius
        columns = jnp.concatenate([view, jnp.stack([1 / radius, strength], -1), points.color.astype(dtype)], 1)
        table = jnp.where(usable[:, None], columns, 0)
        splat = None
        if points.splats_beyond is not None:
            away = jnp.linalg.norm(offset, axis=1) if camera.is_perspective else view[:, 2]
            splat = lax.stop_gradient(away) > points.splats_beyond
        fault = faults.raised(faults.BAD_POINTS, (points.valid & ~usable).any())
        axes = camera.axes.astype(dtype)
        return cls(table, points.attributes, axes, splat, points.profile, fault, None, first, points.spread)

    def in_band(self, grid: Grid) -> PointsMedium:
        """With the lists of a band."""
        return dataclasses.replace(self, lists=Listed(grid.lists.rank, grid.ordered.index, grid.half_steps[::2]))

    def faults(self) -> Int[Array, ""]:
        """Whether all numbers are usable."""
        return self.fault

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Nothing of its own: spheres are in the grid, by which slabs are filled."""
        return jnp.zeros_like(slabs.z_lower, bool)

    def gather(self, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], ...]:
        """Thickness of all samples, and thickness times red, green and blue."""
        sums = sums_of([jnp.zeros(task.shape, self.table.dtype)] * 4)
        for turns in task.turns(BLOCK, PARTS):
            add = functools.partial(self._add, turns.task)
            sums = turns.put(lax.fori_loop(turns.begin, turns.end, add, turns.of(sums)), sums)
        return tuple(sums.all)

    def _add(self, task: SlabTask, nth: Array, sums: Sums) -> Sums:
        """With a block of points more."""
        rays = PointRays.of(task, self.axes)

        def found(nth: Array) -> tuple[list[Array], Array]:
            some = self._fetch(task, nth)
            return [some.row.red, some.row.green, some.row.blue], self._thickness(some, rays)

        colors, thickness = fusion_barrier(nth >= 0, found, nth)
        channels = list(sums.all)
        for k in range(BLOCK):
            here = thickness[:, k]
            weighed = (here * color[:, k, None, None] for color in colors)
            channels = [channels[0] + here, *(old + new for old, new in zip(channels[1:], weighed, strict=True))]
        return sums_of(channels)

    def extinction(
        self, gathered: tuple[Array, ...], task: SlabTask
    ) -> tuple[Float[Array, "tasks samples rays"], tuple[Array, ...]]:
        """Mean extinction of samples."""
        path = task.path()
        return ratio(gathered[0], path), gathered

    def colors(self, samples: tuple[Array, ...], task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Weighed by thickness."""
        thickness, *weighed = samples
        inverse = ratio(1.0, thickness)
        return [value * inverse for value in weighed[channels]]

    def no_cotangents(self) -> PointsMedium:
        """None yet; of the points themselves, not of where they are listed."""
        return jax.tree.map(jnp.zeros_like, dataclasses.replace(self, lists=None))

    def pull(  # type: ignore[override]
        self, total: PointsMedium, gathered: tuple[Array, ...], task: SlabTask, cotangents: list[Array]
    ) -> tuple[PointsMedium, OfPlaces]:
        """See `Medium.pull`: sums have the same cotangents for each point, which is met again."""

        def met(sums: tuple[Array, ...], places: OfPlaces) -> list[Array]:
            return self.optics(sums, _moved(task, places))

        there = OfPlaces(task.depth, task.border, jnp.ones_like(task.depth[0, 0]))
        of_gathered, places = jax.vjp(met, gathered, there)[1](cotangents)
        of_sums = jnp.stack(of_gathered)

        def add(nth: Array, carry: tuple[Any, ...], number: int, part: SlabTask) -> tuple[Any, ...]:
            table, attributes, axes, profile, places = carry
            some = self._fetch(part, nth)

            def sums(inputs: tuple[Any, ...]) -> Array:
                row, of_some, axes, profile, places = inputs
                medium = dataclasses.replace(self, profile=profile)
                rays = PointRays.of(_moved(task, places).first(number), axes)
                thickness = medium._thickness(some._replace(row=row, attributes=of_some), rays)
                colors = jnp.stack([jnp.ones_like(row.red), row.red, row.green, row.blue])
                return jnp.einsum("cbk,bksr->cbsr", colors, thickness, precision=lax.Precision.HIGHEST)

            inputs = some.row, some.attributes, self.axes, self.profile, there
            row, of_some, of_axes, of_profile, moved = jax.vjp(sums, inputs)[1](of_sums[:, :number])[0]
            at, rows = some.point.ravel(), jnp.stack(row, -1).reshape(-1, NUM_COLUMNS)
            table = table.at[at].add(jnp.where(some.inside.ravel()[:, None], rows, 0), mode="promise_in_bounds")
            attributes = jax.tree.map(lambda old, new: old.at[at].add(new.ravel()), attributes, of_some)
            axes, profile, places = jax.tree.map(jnp.add, (axes, profile, places), (of_axes, of_profile, moved))
            return table, attributes, axes, profile, places

        carry = total.table, total.attributes, total.axes, total.profile, places
        for turns in task.turns(BLOCK, PARTS):
            some = functools.partial(add, number=turns.number, part=turns.task)
            carry = lax.fori_loop(turns.begin, turns.end, some, carry)
        table, attributes, axes, profile, places = carry
        return dataclasses.replace(total, table=table, attributes=attributes, axes=axes, profile=profile), places

    def _fetch(self, task: SlabTask, nth: Array) -> _Some:
        """A block of the spheres in the windows of slabs."""
        if self.lists is None:
            raise ValueError("points are asked for without the lists of a band; call `in_band` first")
        index, entry = nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32), task.entry
        rank, inside = particle_at(self.lists.rank, entry.begin[..., None], entry.length[..., None], index)
        number = self.lists.number[rank] - self.first
        inside &= (number >= 0) & (number < self.table.shape[0])
        point = jnp.clip(number, 0, self.table.shape[0] - 1)
        row = jnp.where(inside[..., None], self.table[point], 0)
        splat = None if self.splat is None else self.splat[point]
        return _Some(
            Row(*jnp.moveaxis(row, -1, 0)), {name: one[point] for name, one in self.attributes.items()}, point, inside, splat
        )

    def _thickness(self, some: _Some, rays: PointRays) -> Float[Array, "tasks points samples rays"]:
        """Of the samples of rays, by each of some points."""
        row = Row(*(column[:, :, None] for column in some.row))
        foot, away = rays.nearest(row)
        away = [offset * row.inverse for offset in away]
        square = away[0] ** 2 + away[1] ** 2 + away[2] ** 2
        inside = square < 1
        half = jnp.where(inside, jnp.sqrt(jnp.where(inside, 1 - square, 1)), 0)[:, :, None]

        def chords() -> Array:
            scale = (rays.slant[:, None] * row.inverse)[:, :, None]
            at = (rays.border[:, None] - foot[:, :, None]) * scale
            return self._along(some, rays, away, square, clamped(at, -half, half))

        def whole() -> Array:
            middle = foot if self.spread == "feet" else jnp.broadcast_to(row.z, foot.shape)
            behind = (rays.border[:, None] >= middle[:, :, None]).astype(half.dtype)
            there = behind[:, :, 1:] - behind[:, :, :-1]  # in the sample that begins in front of it, and ends behind
            return self._along(some, rays, away, square, jnp.concatenate([-half, half], 2)) * there

        found = self._spread(some, chords, whole)
        return jnp.where(inside[:, :, None], found, 0) * row.strength[:, :, None]

    def _spread(self, some: _Some, chords: Callable[[], Array], whole: Callable[[], Array]) -> Array:
        """What a set has along its chords or whole; of splats and others, both only where there are both."""
        if self.spread == "centres" or (some.splat is None and self.spread == "feet"):
            return whole()
        if some.splat is None:
            return chords()
        splat = some.splat[:, :, None, None]

        def both() -> Array:
            return jnp.where(splat, whole(), chords())

        return lax.cond((some.splat | ~some.inside).all(), whole, both)

    def _along(self, some: _Some, rays: PointRays, away: list[Array], square: Array, ends: Array) -> Array:
        """Integrals of the profile between neighbouring `ends`, in radii."""
        if isinstance(self.profile, Shaped):
            foot = [part[:, :, None] for part in rays.in_world(away)]
            direction = [part[:, None, None] for part in rays.direction_in_world()]
            attributes = {name: one[:, :, None, None] for name, one in some.attributes.items()}
            chord = Chord((foot[0], foot[1], foot[2]), (direction[0], direction[1], direction[2]), attributes)
            return self.profile.along_chord(chord, ends[:, :, :-1], ends[:, :, 1:])
        return self.profile.along(square[:, :, None], ends[:, :, :-1], ends[:, :, 1:])


class _Some(NamedTuple):
    """A block of points of each task; `inside` where there is one."""

    row: Row
    attributes: dict[str, Array]
    point: Int[Array, "tasks points"]
    inside: Bool[Array, "tasks points"]
    splat: Bool[Array, "tasks points"] | None


def _moved(task: SlabTask, places: OfPlaces) -> SlabTask:
    return dataclasses.replace(task, depth=places.depth, border=places.border, u=task.u * places.factor, v=task.v * places.factor)
