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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.field.sums import Sums, particle_at, pull_blocks, sums_of
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.shown import Band
from jaxsph.model.camera.camera import Camera
from jaxsph.model.medium import Cotangents, Medium, Places
from jaxsph.model.points import Chord, Points, Profile, Shaped
from jaxsph.numerics import faults
from jaxsph.numerics.compiled import clamped, fusion_barrier, ratio
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
    """

    u: Float[Array, "tasks rays"]
    v: Float[Array, "tasks rays"]
    border: Float[Array, "tasks samples_and_one 1"]
    slant: Float[Array, "tasks rays"]
    perspective: bool

    @classmethod
    def of(cls, task: SlabTask) -> PointRays:
        """Of the slabs of a task."""
        u, v = task.ray_coordinates()
        slant = jnp.sqrt(1 + u * u + v * v) if task.perspective else jnp.ones_like(u)
        return cls(u, v, task.border[..., None], slant, task.perspective)

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


@tree(static=("first", "spread", "names"))
class PointsMedium(Medium):
    """A point set in view space.

    Attributes:
        table: `Row` of each point, and then its attributes.
        axes: of the camera, rows: for profiles that are not radial.
        splat: which are splats; None where none are.
        profile, spread: see `Points`.
        first: number of the first point among all spheres of the scene.
        names: of attributes, in the order of their columns; none for radial profiles, which read none.
        rank, number: of a band: spheres by rank in the lists of bundles, and their numbers in the scene.
    """

    between_samples = True
    exact_means = True
    table: Float[Array, "points columns"]
    axes: Float[Array, "3 3"]
    splat: Bool[Array, " points"] | None
    profile: Profile
    first: int
    spread: str
    names: tuple[str, ...]
    fault: Int[Array, ""]
    rank: Int[Array, " pairs"] | None = None
    number: Int[Array, " spheres"] | None = None

    @classmethod
    def seen(cls, points: Points, camera: Camera, first: int) -> PointsMedium:
        """As a camera sees them.

        Differentiation:
            By all numbers of the points, and by the camera. Which are splats, and the samples of feet and centres, is held
            fixed.
        """
        dtype = jnp.promote_types(points.dtype, camera.dtype)
        offset = camera.offset(points.position, points.position_rest)
        view = camera.rotate(offset).astype(dtype)
        usable = points.usable()
        radius = jnp.where(usable, points.radius, 1).astype(dtype)
        strength = jnp.where(usable, points.extinction, 0).astype(dtype) * radius
        columns = jnp.concatenate([view, jnp.stack([1 / radius, strength], -1), points.color.astype(dtype)], 1)
        names = tuple(sorted(points.attributes)) if isinstance(points.profile, Shaped) else ()
        attributes = [points.attributes[name].astype(dtype)[:, None] for name in names]
        table = jnp.concatenate([jnp.where(usable[:, None], columns, 0), *attributes], 1)
        splat = None
        if points.splats_beyond is not None:
            away = jnp.linalg.norm(offset, axis=1) if camera.is_perspective else view[:, 2]
            splat = lax.stop_gradient(away) > points.splats_beyond
        fault = faults.raised(faults.BAD_POINTS, (points.valid & ~usable).any())
        return cls(table, camera.axes.astype(dtype), splat, points.profile, first, points.spread, names, fault)

    @property
    def spheres(self) -> slice:
        """Its points."""
        return slice(self.first, self.first + self.table.shape[0])

    def in_band(self, band: Band) -> PointsMedium:
        """With the lists of a band."""
        return dataclasses.replace(self, rank=band.grid.lists.rank, number=band.grid.ordered.index)

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Nothing of its own: spheres are in the grid, by which slabs are filled."""
        return jnp.zeros_like(slabs.z_lower, bool)

    def gather(self, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], ...]:
        """Thickness of all samples, and thickness times red, green and blue."""
        return tuple(task.over_blocks(BLOCK, PARTS, self._add, sums_of([jnp.zeros(task.shape, self.table.dtype)] * 4)).all)

    def _add(self, task: SlabTask, nth: Array, sums: Sums) -> Sums:
        rays = PointRays.of(task)

        def found(nth: Array) -> tuple[list[Array], Array]:
            _, rows, held = self._fetch(task, nth)
            row = held.row(rows)
            return [row.red, row.green, row.blue], self._thickness(row, rows, held, rays)

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

    def pull_gather(
        self, total: Cotangents, gathered: tuple[Array, ...], task: SlabTask, cotangents: tuple[Array, ...]
    ) -> tuple[Cotangents, Places]:
        """See `Medium.pull_gather`: sums have the same cotangents for each point, which is met again."""
        own, of_sums, shared = total.own, jnp.stack(cotangents), (self.axes, self.profile, Places.of(task))
        table, found = own.table, jax.tree.map(jnp.zeros_like, shared)
        for some, begin, end in task.turns(BLOCK, PARTS):
            number = some.depth.shape[0]

            def sums(rows: Array, shared: tuple[Any, ...], held: _Held, number: int = number) -> Array:
                (axes, profile, places), row = shared, held.row(rows)
                rays = PointRays.of(places.moved(task).at(slice(number)))
                thickness = dataclasses.replace(self, axes=axes, profile=profile)._thickness(row, rows, held, rays)
                colors = jnp.stack([jnp.ones_like(row.red), row.red, row.green, row.blue])
                return jnp.einsum("cbk,bksr->cbsr", colors, thickness, precision=lax.Precision.HIGHEST)

            fetch = functools.partial(self._fetch, some)
            table, more = pull_blocks(sums, fetch, (begin, end), table, shared, of_sums[:, :number])
            found = jax.tree.map(jnp.add, found, more)
        of_axes, of_profile, places = found
        axes, profile = jax.tree.map(jnp.add, (own.axes, own.profile), (of_axes, of_profile))
        return total._replace(own=dataclasses.replace(own, table=table, axes=axes, profile=profile)), places

    def _fetch(self, task: SlabTask, nth: Array) -> tuple[Int[Array, "tasks points"], Array, _Held]:
        """A block of the spheres in the windows of slabs: which points they are, their rows, and what is held fixed of them."""
        if self.rank is None or self.number is None:
            raise ValueError("points are asked for without the lists of a band; call `in_band` first")
        index, entry = nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32), task.entry
        rank, inside = particle_at(self.rank, entry.begin[..., None], entry.length[..., None], index)
        number = self.number[rank] - self.first
        inside &= (number >= 0) & (number < self.table.shape[0])
        point = jnp.clip(number, 0, self.table.shape[0] - 1)
        return point, self.table[point], _Held(inside, None if self.splat is None else self.splat[point])

    def _thickness(self, row: Row, rows: Array, held: _Held, rays: PointRays) -> Float[Array, "tasks points samples rays"]:
        """Of the samples of rays, by each of some points."""
        row = Row(*(column[:, :, None] for column in row))
        attributes = {name: rows[:, :, NUM_COLUMNS + k, None, None] for k, name in enumerate(self.names)}
        foot, away = rays.nearest(row)
        away = [offset * row.inverse for offset in away]
        square = away[0] ** 2 + away[1] ** 2 + away[2] ** 2
        inside = square < 1
        half = jnp.where(inside, jnp.sqrt(jnp.where(inside, 1 - square, 1)), 0)[:, :, None]

        def chords() -> Array:
            scale = (rays.slant[:, None] * row.inverse)[:, :, None]
            at = (rays.border[:, None] - foot[:, :, None]) * scale
            return self._along(attributes, rays, away, square, clamped(at, -half, half))

        def whole() -> Array:
            place = foot if self.spread == "feet" else jnp.broadcast_to(row.z, foot.shape)
            if self.spread == "feet" and held.splat is not None:
                place = jnp.where(held.splat[:, :, None], row.z, place)
            behind = (rays.border[:, None] >= place[:, :, None]).astype(half.dtype)
            there = behind[:, :, 1:] - behind[:, :, :-1]  # in the sample that begins in front of it, and ends behind
            return self._along(attributes, rays, away, square, jnp.concatenate([-half, half], 2)) * there

        if self.spread != "chords":
            found = whole()
        elif held.splat is None:
            found = chords()
        else:
            splat = held.splat[:, :, None, None]
            found = lax.cond((held.splat | ~held.inside).all(), whole, lambda: jnp.where(splat, whole(), chords()))
        return jnp.where(inside[:, :, None], found, 0) * row.strength[:, :, None]

    def _along(self, attributes: dict[str, Array], rays: PointRays, away: list[Array], square: Array, ends: Array) -> Array:
        """Integrals of the profile between neighbouring `ends`, in radii."""
        if isinstance(self.profile, Shaped):
            axes, across = self.axes, (rays.u, rays.v) if rays.perspective else (jnp.zeros_like(rays.u),) * 2
            direction = [part / rays.slant for part in (*across, jnp.ones_like(rays.u))]  # of length 1

            def in_world(view: list[Array], space: Any) -> tuple[Array, Array, Array]:
                x, y, z = ((axes[0, k] * view[0] + axes[1, k] * view[1] + axes[2, k] * view[2])[space] for k in range(3))
                return x, y, z

            chord = Chord(in_world(away, np.s_[:, :, None]), in_world(direction, np.s_[:, None, None]), attributes)
            return self.profile.along_chord(chord, ends[:, :, :-1], ends[:, :, 1:])
        return self.profile.along(square[:, :, None], ends[:, :, :-1], ends[:, :, 1:])


class _Held(NamedTuple):
    """Of a block of points of each task, where there is one, and which are splats."""

    inside: Bool[Array, "tasks points"]
    splat: Bool[Array, "tasks points"] | None

    def row(self, rows: Float[Array, "tasks points columns"]) -> Row:
        """Of rows of the table, nothing where there is none."""
        return Row(*jnp.moveaxis(jnp.where(self.inside[..., None], rows[..., :NUM_COLUMNS], 0), -1, 0))
