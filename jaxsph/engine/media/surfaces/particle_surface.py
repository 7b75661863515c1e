r"""The surface of particles as a medium: opaque where a ray first crosses a level of their coverage, shaded by its gradient.

Flow: grid, schedule -> [particle_surface: borders -> crossing -> root -> light] -> integrator.

**Where a ray crosses** is found by `crossing`, slab by slab, and followed by a step of Newton's (`root_near`) to some roundings
of a support. Slabs with a ray that this leaves farther off, as it grazes the surface, are looked at again.

**What is found, and what may be missed.** All that crosses the level an odd number of times between neighbouring borders. Of
what enters and leaves between two of them: whatever one particle alone makes, as the place that is asked for is then its foot,
where it weighs most; and of what several make together that which holds the mean of their feet, or the vertex. An *estimate*
are two things: several thin parts in one interval, none of which one particle makes alone; and a gap in the fluid that is
thinner than an interval, of a ray that begins in the fluid. More samples find them. A clip's face is such a place, too: what is
thin in the intervals that it cuts is an estimate as well.

However a root was found, only its place counts, by the implicit function theorem: with F the field, p all that it depends on and
t the depth of a crossing, $F(t, p) = c$ makes t a function whose derivatives are those of one step of Newton's with its slope
held fixed, $dt = (dc - F_p \, dp) / F_t$; what is found there, G, moves by $G_p \, dp + G_t \, dt$. Backward, one more pass over
particles finds the derivatives along rays, and another takes cotangents to particles.

**Occlusion** of short reach is told by the coverage around: with Gaussians of a width $\sigma$ in place of kernels,
$B(x) = \sum_j V_j G_\sigma(x - x_j)$, sampled at $x + a n$, in front of a place x by $a = 3/2 \sigma$ along the normal n out of
the fluid. In front of what is flat that is $b = \Phi(-a/\sigma)$ of what it is within, where it bulges less, and in its folds
more: of the light from all around $\max(B - b, 0) / (1 - b)$ is held to be hidden. As all directions are averaged over, it is
smooth, and the same from wherever one looks. B is looked up on a grid around the particles in the picture, made once a
frame, but for strays far from most of them; $\sigma$ is the median support, or more where that is too little for the grid.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.view import Ordered, Viewed, weight_of
from jaxsph.engine.access.volume_grid import VolumeGrid
from jaxsph.engine.field.cover import over_groups, rows_of
from jaxsph.engine.field.gather import gather
from jaxsph.engine.field.piercing import Found, Piercing, upper_of_packets
from jaxsph.engine.field.sums import by_rays
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.shown import Band
from jaxsph.engine.media.surfaces.crossing import Bracket, at_crossings, first_crossings, newton
from jaxsph.engine.media.surfaces.iso_surface import OPAQUE, Vector, dot, headlight
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Clip
from jaxsph.model.medium import COLORS, Cotangents, Medium, Places, Stops
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Surface
from jaxsph.model.transfer.function import Segments, TransferFunction, look_up
from jaxsph.model.volume import Volume
from jaxsph.numerics import faults
from jaxsph.numerics.compiled import clamped, fusion_barrier, ratio, side_by_side
from jaxsph.numerics.trees import tree

BESIDE = 64  # eps of a quantity and of what it is relative to, up to which it may lie before a kink and count as behind
SIDE = 96  # points of the grid along each axis
AWAY, LEAST_CELLS, MARGIN = 1.5, 1.5, 4.0  # of sigma: where it is looked up; cells, at least; and room around all particles
FLAT = 0.5 * math.erfc(AWAY / math.sqrt(2))  # what is there of a half space whose surface that is
STRAYS = 0.05  # of particles, beyond which on either side of an axis none is farther away than most are apart
STEPS = 2**16 - 1  # kept as whole numbers: they have no derivatives, and take half of the memory
Rows = list[Float[Array, "tasks rays"]]


class Hit(NamedTuple):
    """Where rays first meet the surface in slabs.

    Attributes:
        interval: which of the slab's it is in; -1 for none.
        rows: view depth, infinite where a ray does not; red, green and blue, lit; and x, y and z of the normal out of the fluid,
            in view space, of unit length or 0 for none.
    """

    interval: Int[Array, "tasks rays"]
    rows: Float[Array, "tasks 7 rays"]


def lamp(normal: Vector, light: Float[Array, "3"], ambient: Float[Array, ""]) -> Float[Array, "..."]:
    """Ambient light, and that of a lamp far away and as wide as the sky around it: $(1 + n l) / 2$ of it at a normal n.

    So no side is black, nor any rim; what faces nowhere has a half.

    Args:
        normal: x, y and z of a vector across the surface in view space, of unit length or 0.
        light: to the lamp, rightwards, upwards and towards the eye; of any length.
        ambient: share of the light that a surface has which faces away from it.
    """
    right, up, back = light * ratio(1.0, jnp.sqrt((light**2).sum()))
    return ambient + (1 - ambient) * 0.5 * (1 + dot(normal, (right, up, -back)))


@tree()
class Surroundings:
    """The coverage by particles, smoothed over what is around: 1 within a fluid.

    Attributes:
        grid: `STEPS` times that, on a grid in view space.
        away: where it is looked up, in front of a surface, length units.
    """

    grid: VolumeGrid
    away: Float[Array, ""]

    @classmethod
    def of(cls, particles: Particles, level: Float[Array, ""], camera: Camera, seen: Any = True) -> Surroundings:
        """Of particles in the world, by twice the level of their surface: a half is halfway into the fluid. Held fixed.

        Particles that are `seen` say how wide it is, without the few that are far from most of them: no fluid is around these.
        """
        particles, level, camera = lax.stop_gradient((particles, level, camera))
        place, dtype = particles.position, particles.support.dtype
        counts = particles.valid & (particles.volume > 0) & jnp.isfinite(place).all(1)
        volume, far, body = jnp.where(counts, particles.volume, 0), jnp.finfo(dtype).max, counts & seen
        number = body.sum()
        last = jnp.maximum(number - 1, 0)
        support = jnp.where(number > 0, jnp.sort(jnp.where(body, particles.support, far))[last // 2], 1)  # a sum needs room
        ascending = jnp.where(number > 0, jnp.sort(jnp.where(body[:, None], place, far), 0), 0)
        some = jnp.clip(jnp.ceil(STRAYS * number).astype(jnp.int32), 1, jnp.maximum(last // 2, 1))
        some = jnp.where(number > 2, some, 0)
        low, high = ascending[some], ascending[last - some]
        around = jnp.maximum((high - low).max(), support)
        lower, upper = jnp.maximum(ascending[0], low - around), jnp.minimum(ascending[last], high + around)
        size = upper - lower
        wide = jnp.maximum(support, LEAST_CELLS * size.max() / (SIDE - 1 - 2 * MARGIN * LEAST_CELLS))
        lower, cell = lower - MARGIN * wide, (size + 2 * MARGIN * wide) / (SIDE - 1)
        nearest = jnp.round((place - lower) / cell)
        nearest = jnp.where((nearest >= 0) & (nearest < SIDE), nearest, SIDE).astype(jnp.int32)
        made = jnp.zeros((SIDE,) * 3, dtype).at[tuple(nearest.T)].add(volume * ratio(0.5, level), mode="drop")
        steps = jnp.arange(SIDE, dtype=dtype)
        for step in cell:  # axis after axis, the first of what is left each time, which becomes the last
            weights = jnp.exp(-0.5 * ((steps[:, None] - steps) * (step / wide)) ** 2) / (wide * math.sqrt(2 * math.pi))
            made = jnp.tensordot(made, weights, ([0], [0]), precision=lax.Precision.HIGHEST)
        values = jnp.round(STEPS * clamped(made, 0, 1)).astype(jnp.uint16)
        grid = VolumeGrid.seen(Volume(values, lower, cell, jnp.zeros_like(lower)), camera)
        return cls(grid, AWAY * wide)

    def hidden(self, place: Vector, normal: Vector) -> Float[Array, "tasks rays"]:
        """Share of the light from all around that fluid is in the way of, at view coordinates with a normal of unit length."""
        at = lax.stop_gradient([(here + self.away * along)[:, None] for here, along in zip(place, normal, strict=True)])
        around = self.grid.interpolate(self.grid.coordinates(tuple(at)))[:, 0] / STEPS
        return clamped((around - FLAT) / (1 - FLAT), 0, 1)


@tree(static=("kernel", "exact"))
class ParticleSurface(Medium):
    """The surface of a scene's particles in view space, see `jaxsph.Surface`.

    Attributes:
        level: as a sum of weights, see `access.view.weight_of`.
        color: red, green and blue where no transfer function colours it.
        ambient: share of the light that it has where it is seen edge on, or faces away from the lamp.
        light: to the lamp, see `lamp`; None is that at the eye.
        occlusion: what of the light is taken that fluid around is in the way of; None where that is not asked for.
        segments: of the transfer function that colours it; None without one.
        clip: where it is shown; None everywhere.
        kernel: name of the smoothing kernel.
        fault: fault word.
        ordered, rank: particles and lists of a band.
        around: by which occlusion is told.
    """

    between_samples = True
    exact_means = True
    stops_rays = only_stops = True
    level: Float[Array, ""]
    color: Float[Array, "3"]
    ambient: Float[Array, ""]
    light: Float[Array, "3"] | None
    occlusion: Float[Array, ""] | None
    segments: Segments | None
    clip: Clip | None
    kernel: str
    fault: Int[Array, ""]
    ordered: Ordered | None = None
    rank: Int[Array, " pairs"] | None = None
    exact: bool = True
    around: Surroundings | None = None

    @classmethod
    def seen(
        cls,
        surface: Surface,
        particles: Particles,
        viewed: Viewed,
        transfer: TransferFunction | None,
        clip: Clip | None,
        camera: Camera,
    ) -> ParticleSurface:
        """Of particles as a camera sees them, with supports that are widened already."""
        dtype = viewed.x.dtype
        given = {name: jnp.asarray(value, dtype) for name, value in surface.numbers.items() if name != "smoothing"}
        level, look = given.pop("level"), {"light": None, "occlusion": None} | given
        finite = (jnp.isfinite(one).all() for one in (level, *given.values()))
        usable: Array = functools.reduce(jnp.logical_and, finite, level > 0)
        around = None if surface.occlusion is None else Surroundings.of(particles, level, camera, viewed.in_picture)
        segments = None if transfer is None else jax.tree.map(lambda leaf: leaf.astype(dtype), transfer).parts()[0].segments()
        level, fault = weight_of(level, particles, viewed.live), faults.raised(faults.BAD_SURFACE, ~usable)
        more: dict[str, Any] = {"segments": segments, "clip": clip, "kernel": particles.kernel, "exact": surface.exact}
        return cls(level, **look, **more, fault=fault, around=around)  # type: ignore[arg-type]

    def in_band(self, band: Band) -> ParticleSurface:
        """With the particles of a band."""
        return dataclasses.replace(self, ordered=band.grid.ordered, rank=band.grid.lists.rank)

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Nothing of its own: particles are in the grid, by which slabs are filled."""
        return jnp.zeros_like(slabs.z_lower, bool)

    def meets(self, task: SlabTask) -> Bool[Array, " tasks"]:
        """Slabs in which all rays together are near enough to particles: no ray meets the surface in others."""
        return upper_of_packets(*self.lists(), task, self.kernel) >= self.level

    def gather(self, task: SlabTask) -> Hit:
        """Where the rays of slabs first meet the surface, and how it looks there.

        Differentiation:
            As of an implicit function, see `root_near`. Which rays meet it has none: silhouettes do not move.
        """
        on_borders = task.on_borders()
        still, held = lax.stop_gradient((self, on_borders))
        (ordered, rank), entry = still.lists(), dataclasses.replace(held.entry, references=())
        ordered = dataclasses.replace(ordered, quantity=None, extinction_quantity=None)  # type: ignore[arg-type]
        weight = by_rays(gather(ordered, rank, dataclasses.replace(held, entry=entry), self.kernel))[0]
        bracket = first_crossings(still.rays, still.meets, held, weight, still.level, still.clip, self.exact)

        def look(between: Bracket, rays: Piercing, again: Array) -> Array:
            place, found = root_near(rays, between, self.level, again)
            light = self.shade(rays, found, rays.ray(), self.hidden(rays, place, found))
            return side_by_side([place + rays.middle, *light, found.weight - self.level], 1)

        found = at_crossings(self.rays, on_borders, bracket, still.level, look, 8, self.exact)[:, :7]
        unmet = ~bracket.met[:, None] & (np.arange(7) == 0)[:, None]
        return Hit(bracket.interval.astype(jnp.int32), jnp.where(unmet, jnp.inf, found))

    def lists(self) -> tuple[Ordered, Int[Array, " pairs"]]:
        """Particles and lists of its band."""
        if self.ordered is None or self.rank is None:
            raise ValueError("a surface is asked for without the lists of a band; call `in_band` first")
        return self.ordered, self.rank

    def rays(self, task: SlabTask) -> Piercing:
        """The rays of slabs, and particles in their windows."""
        return Piercing.through(*self.lists(), task, self.kernel)

    def hidden(self, rays: Piercing, place: Array, found: Found) -> Array | None:
        """What of the light is hidden by fluid around where rays meet the surface; held fixed. None where it is not asked for."""
        if self.around is None:
            return None
        around, rays, place, found = lax.stop_gradient((self.around, rays, place, found))
        at = [at[:, 0] for at in rays.at(place[:, None])]
        return fusion_barrier(rays.blocks >= 0, around.hidden, at, _normal(found))  # type: ignore[no-any-return]

    def shade(self, rays: Piercing, found: Found, ray: Rows, hidden: Array | None) -> Rows:
        """Red, green and blue, lit; and the normal out of the fluid, of unit length, 0 where the field has no slope."""
        normal, colors = _normal(found), list(self.color)
        light = headlight(normal, ray, self.ambient) if self.light is None else lamp(normal, self.light, self.ambient)
        if hidden is not None and self.occlusion is not None:
            light = light * (1 - self.occlusion * hidden)
        if self.segments is not None:
            reference = rays.task.entry.references[0][:, None]
            colors = _painted(self.segments, reference + found.weighted[0] * ratio(1.0, found.weight), reference)
        return [*(color * light for color in colors), *normal]

    def extinction(self, gathered: Hit, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Hit]:
        """Opaque where the surface is."""
        met = gathered.interval[:, None] == jnp.arange(task.shape[1], dtype=jnp.int32)[:, None]
        return jnp.where(met, ratio(OPAQUE, task.path()), 0), gathered

    def colors(self, samples: Hit, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Of the surface, lit."""
        return [jnp.broadcast_to(samples.rows[:, 1 + k, None], task.shape) for k in range(3)[channels]]

    def stops(self, gathered: Hit, task: SlabTask) -> Stops:
        """See `Medium.stops`."""
        return tuple(gathered.rows[:, k] for k in (0, 4, 5, 6))  # type: ignore[return-value]

    def pull_gather(self, total: Cotangents, gathered: Hit, task: SlabTask, cotangents: Hit) -> tuple[Cotangents, Places]:
        """See `Medium.pull_gather`. Where the borders of slabs are changes no crossing."""
        met, tasks, one = gathered.interval >= 0, gathered.rows.shape[0], jnp.ones((), gathered.rows.dtype)
        own = dataclasses.replace(self, ordered=None, rank=None)

        def pull_some(items: Array, some: SlabTask, carry: tuple[Cotangents, Array]) -> tuple[Cotangents, Array]:
            (there, depth, of_rows), real = rows_of((met, gathered.rows[:, 0], cotangents.rows), items), (items < tasks)[:, None]
            total, factor = carry
            rays = self.rays(some)
            place = jnp.where(there, depth, 0) - rays.middle
            found, along = jax.jvp(rays.found, (place,), (jnp.ones_like(place),))
            hidden = self.hidden(rays, place, found)

            def shown(surface: ParticleSurface, found: Found, factor: Array) -> Array:
                step = newton(jnp.zeros_like(place), found.weight - surface.level, along.weight)
                step = step - lax.stop_gradient(step)
                found = jax.tree.map(lambda here, moved: here + step * moved, found, along)
                u, v, forward = rays.ray()
                return jnp.stack([step, *surface.shade(rays, found, [u * factor, v * factor, forward], hidden)], 1)

            of_rows = jnp.where((there & real)[:, None], of_rows, 0)
            of_own, of_found, of_factor = jax.vjp(shown, own, found, one)[1](of_rows)
            table, more = rays.pull(total.table, place, of_found)
            return total._replace(table=table).with_own(of_own), factor + of_factor + more

        total, factor = over_groups(pull_some, (total, jnp.zeros_like(one)), task.on_borders(), ~met[:, None])
        return total, Places.none(task)._replace(factor=factor)


def _normal(found: Found) -> Rows:
    """Out of the fluid, of unit length; 0 where the field has no slope."""
    steepest = lax.stop_gradient(jnp.stack([abs(of) for of in found.gradient]).max(0))
    gradient = [jnp.where(steepest > 0, of / jnp.where(steepest > 0, steepest, 1), 0) for of in found.gradient]
    square = dot(gradient, gradient)
    return [-of * lax.rsqrt(jnp.where(square > 0, square, 1)) for of in gradient]


def root_near(rays: Piercing, bracket: Bracket, level: Float[Array, ""], is_root: Bool[Array, ""]) -> tuple[Array, Found]:
    """The root in a bracket, by a step of Newton's from its secant, which has the derivatives; and what is found there.

    Where the secant `is_root` it stays, and the step has the derivatives alone.

    Differentiation:
        By the particles, the rays and the level, as of an implicit function; the bracket has none.
    """
    bracket = lax.stop_gradient(bracket)
    given, ray = bracket.secant(), rays.ray()

    def find(nth: Array, root: tuple[Array, Found]) -> tuple[Array, Found]:
        found = root[1]  # the slope is 0 before anything is
        slope = lax.stop_gradient(dot(found.gradient, ray))
        place = newton(given, found.weight - level, slope)
        taken = jnp.where(is_root | (nth == 0), given, clamped(place, bracket.low, bracket.high))
        place = place + lax.stop_gradient(taken - place)
        return place, rays.found(place)

    zero = jnp.zeros_like(given)
    nothing = Found(zero, (zero,) * 3, (zero,) * len(rays.task.entry.references))
    return lax.fori_loop(0, 2, find, (given, nothing))  # at the secant, and at the root


@jax.custom_jvp
def _painted(segments: Segments, quantity: Array, reference: Array) -> list[Array]:
    return look_up(segments, quantity)[COLORS]


@_painted.defjvp
def _painted_moved(primals: tuple[Any, Array, Array], moves: tuple[Any, Array, Any]) -> tuple[list[Array], list[Array]]:
    """On a kink with the slope of what begins there, though the root that is found again backward is a rounding away."""
    segments, quantity, reference = primals
    ahead = quantity + BESIDE * jnp.finfo(quantity.dtype).eps * (abs(quantity) + abs(reference))
    return _painted(*primals), jax.jvp(look_up, (segments, ahead), moves[:2])[1][COLORS]
