r"""The surface of particles as a medium: opaque where a ray first crosses a level of their coverage, shaded by its gradient.

Flow: grid, schedule -> [particle_surface: borders -> crossing -> root -> light] -> integrator.

**Where a ray crosses** is found by `field.crossing`, slab by slab, and followed by a step of Newton's (`root`) to some
roundings of a support. Slabs with a ray that this leaves farther off, as it grazes the surface, are looked at again.

**What is found, and what may be missed.** All that crosses the level an odd number of times between neighbouring borders. Of
what enters and leaves between two of them: whatever one particle alone makes, as the place that is asked for is then its foot,
where it weighs most; and of what several make together that which holds the mean of their feet, or the vertex. An *estimate*
are two things: several thin parts in one interval, none of which one particle makes alone; and a gap in the fluid that is
thinner than an interval, of a ray that begins in the fluid. More samples find them.

A clip's face is such a place, too, in the intervals that it cuts: what is thin there is an estimate as well.

However a root was found, only its place counts, by the implicit function theorem: with F the field, p all that it depends on and
t the depth of a crossing, $F(t, p) = c$ makes t a function whose derivatives are those of one step of Newton's with its slope
held fixed, $dt = (dc - F_p \, dp) / F_t$; what is found there, G, moves by $G_p \, dp + G_t \, dt$. Backward, $\bar G$ gives the
place the cotangent $\bar t + \bar G \cdot G_t$, the field minus that over $F_t$, in one more pass over particles.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.view import Ordered, Viewed, weight_of
from jaxsph.engine.field.cover import over_groups, rows_of
from jaxsph.engine.field.crossing import Bracket, Cut, at_crossings, first_crossings
from jaxsph.engine.field.gather import gather, gather_scattered
from jaxsph.engine.field.piercing import Found, Piercing
from jaxsph.engine.field.sums import by_rays
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.shown import Band
from jaxsph.engine.media.surfaces.iso_surface import OPAQUE, headlight
from jaxsph.engine.media.within import parts_of
from jaxsph.model.clips.clips import Clip
from jaxsph.model.medium import COLORS, Cotangents, Medium, Places, Stops, added
from jaxsph.model.particles.particles import Particles
from jaxsph.model.particles.surface import Surface
from jaxsph.model.transfer.function import Segments, TransferFunction, look_up
from jaxsph.numerics import faults
from jaxsph.numerics.extremes import clamped, ratio
from jaxsph.numerics.fusion import side_by_side
from jaxsph.numerics.trees import tree

BESIDE = 64  # eps of a quantity and of what it is relative to, up to which it may lie before a kink and count as behind
Vectors = list[Float[Array, "tasks rays"]]


class Root(NamedTuple):
    """Where rays cross the level, relative to the middle of their slab, and what is found there."""

    place: Float[Array, "tasks rays"]
    found: Found


class OfRoot(NamedTuple):
    """Cotangents of particles, `field.transposed.COLUMNS`, of the level, and of a common factor of all u and v."""

    table: Float[Array, "particles 8"]
    level: Float[Array, ""]
    factor: Float[Array, ""]


@tree()
class SurfaceLook:
    """How a surface looks.

    Attributes:
        color: red, green and blue where no transfer function colours it.
        ambient: share of the light that it has where it is seen edge on.
        segments: of the transfer function that colours it; None without one.
        light: x, y and z in view space of a vector of unit length towards the light; None for one at the eye.
    """

    color: Float[Array, "3"]
    ambient: Float[Array, ""]
    segments: Segments | None
    light: Float[Array, "3"] | None = None

    def shade(self, found: Found, ray: Vectors, reference: Float[Array, "tasks 1"]) -> tuple[Vectors, Vectors]:
        """Red, green and blue, lit; and the normal out of the fluid, of unit length, 0 where the field has no slope."""
        steepest = lax.stop_gradient(jnp.stack([abs(of) for of in found.gradient]).max(0))
        gradient = [jnp.where(steepest > 0, of / jnp.where(steepest > 0, steepest, 1), 0) for of in found.gradient]
        square = gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2
        normal = [-of * lax.rsqrt(jnp.where(square > 0, square, 1)) for of in gradient]
        light = headlight(normal, ray, self.ambient, self.light)
        return [color * light for color in self._colors(found, reference)], normal

    def _colors(self, found: Found, reference: Float[Array, "tasks 1"]) -> list[Float[Array, "..."]]:
        """Red, green and blue before they are lit."""
        if self.segments is None:
            return list(self.color)
        return _painted(self.segments, reference + found.weighted[0] * ratio(1.0, found.weight), reference)


@jax.custom_jvp
def _painted(segments: Segments, quantity: Array, reference: Array) -> list[Array]:
    return look_up(segments, quantity)[COLORS]


@_painted.defjvp
def _painted_moved(primals: tuple[Any, Array, Array], moves: tuple[Any, Array, Any]) -> tuple[list[Array], list[Array]]:
    """On a kink with the slope of what begins there, though the root that is found again backward is a rounding away."""
    segments, quantity, reference = primals
    ahead = quantity + BESIDE * jnp.finfo(quantity.dtype).eps * (abs(quantity) + abs(reference))
    return _painted(*primals), jax.jvp(look_up, (segments, ahead), moves[:2])[1][COLORS]


def slope_along(found: Found, ray: Vectors) -> Float[Array, "tasks rays"]:
    """Of the field, a unit of depth."""
    return found.gradient[0] * ray[0] + found.gradient[1] * ray[1] + found.gradient[2] * ray[2]


def root_near(rays: Piercing, bracket: Bracket, level: Float[Array, ""], is_root: Bool[Array, ""]) -> Root:
    """The root in a bracket, by a step of Newton's from its secant, which has the derivatives; and what is found there.

    Where the secant `is_root` it stays, and the step has the derivatives alone.

    Differentiation:
        By the particles, the rays and the level, as of an implicit function; the bracket has none.
    """
    bracket = lax.stop_gradient(bracket)
    given = bracket.secant()

    def find(nth: Array, root: Root) -> Root:
        slope = lax.stop_gradient(slope_along(root.found, rays.ray()))  # 0 before anything is found
        place = given + jnp.where(slope != 0, (level - root.found.weight) / jnp.where(slope != 0, slope, 1), 0)
        taken = jnp.where(is_root | (nth == 0), given, clamped(place, bracket.low, bracket.high))
        place = place + lax.stop_gradient(taken - place)
        return Root(place, rays.found(place))

    zero = jnp.zeros_like(given)
    nothing = Found(zero, (zero,) * 3, (zero,) * len(rays.task.entry.references))
    return lax.fori_loop(0, 2, find, Root(given, nothing))  # at the secant, and at the root


def pull_root(table: Float[Array, "particles 8"], rays: Piercing, place: Float[Array, "tasks rays"], cotangents: Root) -> OfRoot:
    """Cotangents of all that a root depends on, from those of the root; 0 where the field has no slope along the ray."""
    _, moved = jax.jvp(rays.found, (place,), (jnp.ones_like(place),))
    of_place, of_found = cotangents
    for of, along in zip(jax.tree.leaves(of_found), jax.tree.leaves(moved), strict=True):
        of_place = of_place + of * along
    slope = moved.weight
    of_level = jnp.where(slope != 0, of_place / jnp.where(slope != 0, slope, 1), 0)
    table, factor = rays.pull(table, place, of_found._replace(weight=of_found.weight - of_level))
    return OfRoot(table, of_level.sum(), factor)


class Hit(NamedTuple):
    """Where rays first meet the surface in slabs.

    Attributes:
        depth: view depth; infinite where a ray does not.
        interval: which of the slab's it is in; -1 for none.
        color: red, green and blue, lit.
        normal: of unit length, out of the fluid, in view space; 0 for none.
    """

    depth: Float[Array, "tasks rays"]
    interval: Int[Array, "tasks rays"]
    color: Float[Array, "tasks 3 rays"]
    normal: Float[Array, "tasks 3 rays"]


class Place(NamedTuple):
    """The same of a crossing each, in whichever interval."""

    depth: Float[Array, "tasks rays"]
    color: Float[Array, "tasks 3 rays"]
    normal: Float[Array, "tasks 3 rays"]


@tree(static=("kernel",))
class ParticleSurface(Medium):
    """The surface of a scene's particles in view space, see `jaxsph.Surface`.

    Attributes:
        level: as a sum of weights, see `access.view.weight_of`.
        look: how it looks.
        clip: where it is shown; None everywhere.
        kernel: name of the smoothing kernel.
        fault: fault word.
        ordered, rank: particles and lists of a band.
    """

    at_points = False
    between_samples = True
    exact_means = True
    stops_rays = True
    level: Float[Array, ""]
    look: SurfaceLook
    clip: Clip | None
    kernel: str
    fault: Int[Array, ""]
    ordered: Ordered | None = None
    rank: Int[Array, " pairs"] | None = None

    @classmethod
    def seen(
        cls, surface: Surface, particles: Particles, viewed: Viewed, transfer: TransferFunction | None, clip: Clip | None
    ) -> ParticleSurface:
        """Of particles as a camera sees them, with supports that are widened already; its light in view space."""
        dtype = viewed.x.dtype
        level, color, ambient = (jnp.asarray(one, dtype) for one in (surface.level, surface.color, surface.ambient))
        usable = (level > 0) & jnp.isfinite(level) & jnp.isfinite(color).all() & jnp.isfinite(ambient)
        usable &= True if surface.light is None else jnp.isfinite(surface.light).all()
        segments = None if transfer is None else jax.tree.map(lambda leaf: leaf.astype(dtype), transfer).parts()[0].segments()
        fault = faults.raised(faults.BAD_SURFACE, ~usable)
        light = None if surface.light is None else surface.light.astype(dtype)
        look = SurfaceLook(color, ambient, segments, light)
        return cls(weight_of(level, particles, viewed.live), look, clip, particles.kernel, fault)

    def in_band(self, band: Band) -> ParticleSurface:
        """With the particles of a band."""
        return dataclasses.replace(self, ordered=band.grid.ordered, rank=band.grid.lists.rank)

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Nothing of its own: particles are in the grid, by which slabs are filled."""
        return jnp.zeros_like(slabs.z_lower, bool)

    def gather(self, task: SlabTask) -> Hit:
        """Where the rays of slabs first meet the surface, and how it looks there.

        Differentiation:
            As of an implicit function, see `root`. Which rays meet it has none: silhouettes do not move.
        """
        on_borders, weight = self.on_borders(task)
        still = lax.stop_gradient(self)
        bracket = first_crossings(still.rays, lax.stop_gradient(on_borders), weight, still.level, still.cut())
        place = self.place(on_borders, bracket)
        return Hit(place.depth, bracket.interval.astype(jnp.int32), place.color, place.normal)

    def on_borders(self, task: SlabTask) -> tuple[SlabTask, Float[Array, "tasks borders rays"]]:
        """The task with samples on the borders of what samples stand for, and the field there, held fixed."""
        on_borders, still = task.on_borders(), lax.stop_gradient(self)
        sums = gather_scattered if task.scattered else gather
        return on_borders, by_rays(sums(*still.lists(), lax.stop_gradient(on_borders), self.kernel))[0]

    def place(self, on_borders: SlabTask, bracket: Bracket) -> Place:
        """Where rays cross, of one bracket each, and how the surface looks there."""

        def look(between: Bracket, rays: Piercing, again: Array) -> Array:
            root = root_near(rays, between, self.level, again)
            colors, normal = self.look.shade(root.found, rays.ray(), rays.task.entry.references[0][:, None])
            return side_by_side([root.place + rays.lines.middle, *colors, *normal, root.found.weight - self.level], 1)

        found = at_crossings(self.rays, on_borders, bracket, lax.stop_gradient(self.level), look, 8)
        return Place(jnp.where(bracket.met, found[:, 0], jnp.inf), found[:, 1:4], found[:, 4:7])

    def cut(self) -> Cut | None:
        """The clip, as the search asks for it."""
        clip = self.clip
        if clip is None:
            return None
        return Cut(clip, lambda task: parts_of(task, clip, task.depth, jnp.ones((), task.depth.dtype)))

    def lists(self) -> tuple[Ordered, Int[Array, " pairs"]]:
        """Particles and lists of its band."""
        if self.ordered is None or self.rank is None:
            raise ValueError("a surface is asked for without the lists of a band; call `in_band` first")
        return self.ordered, self.rank

    def rays(self, task: SlabTask) -> Piercing:
        """The rays of slabs, and particles in their windows."""
        return Piercing.of(*self.lists(), task, self.kernel)

    def extinction(self, gathered: Hit, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Hit]:
        """Opaque where the surface is."""
        path = task.path()
        opaque = (gathered.interval[:, None] == jnp.arange(path.shape[1], dtype=jnp.int32)[:, None]) & (path > 0)
        return jnp.where(opaque, ratio(OPAQUE, path), 0), gathered

    def colors(self, samples: Hit, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Of the surface, lit."""
        return [jnp.broadcast_to(samples.color[:, k, None], task.shape) for k in range(3)[channels]]

    def stops(self, gathered: Hit, task: SlabTask) -> Stops:
        """See `Medium.stops`."""
        return gathered.depth, *(gathered.normal[:, k] for k in range(3))  # type: ignore[return-value]

    def pull_gather(self, total: Cotangents, gathered: Hit, task: SlabTask, cotangents: Hit) -> tuple[Cotangents, Places]:
        """See `Medium.pull_gather`. Where the borders of slabs are changes no crossing."""
        of_place = Place(cotangents.depth, cotangents.color, cotangents.normal)
        total, factor = self.pull_place(total, task, gathered.depth, of_place)
        return total, Places.none(task)._replace(factor=factor)

    def pull_place(
        self, total: Cotangents, task: SlabTask, depth: Float[Array, "tasks rays"], cotangents: Place
    ) -> tuple[Cotangents, Float[Array, ""]]:
        """Add what follows from cotangents of a `place`; and those of a common factor of all u and v."""
        met, tasks = jnp.isfinite(depth), depth.shape[0]
        of_hit = jnp.concatenate([cotangents.depth[:, None], cotangents.color, cotangents.normal], 1)

        def pull_some(items: Array, some: SlabTask, carry: tuple[Cotangents, Array]) -> tuple[Cotangents, Array]:
            (there, at, of_rows), real = rows_of((met, depth, of_hit), items), (items < tasks)[:, None]
            of_rows = jnp.where((there & real)[:, None], of_rows, 0)
            return self._pull_some(some, jnp.where(there, at, 0), of_rows, *carry)

        return over_groups(pull_some, (total, jnp.zeros((), depth.dtype)), task.on_borders(), ~met[:, None])

    def _pull_some(
        self,
        task: SlabTask,
        depth: Float[Array, "tasks rays"],
        of_rows: Float[Array, "tasks rows rays"],
        total: Cotangents,
        factor: Float[Array, ""],
    ) -> tuple[Cotangents, Float[Array, ""]]:
        """Add what follows from cotangents of depth, colours and normal, of some slabs whose rays meet the surface at a depth."""
        rays, reference = self.rays(task), task.entry.references[0][:, None]
        place = depth - rays.lines.middle

        def shaded(look: SurfaceLook, found: Found, factor: Array) -> Array:
            u, v, forward = rays.ray()
            colors, normal = look.shade(found, [u * factor, v * factor, forward], reference)
            return jnp.stack([*colors, *normal], 1)

        pull_shade = jax.vjp(shaded, self.look, rays.found(place), jnp.ones_like(factor))[1]
        of_look, of_found, of_factor = pull_shade(of_rows[:, 1:])
        of_root = pull_root(total.table, rays, place, Root(of_rows[:, 0], of_found))
        look, level = added(total.own.look, of_look), total.own.level + of_root.level
        own = dataclasses.replace(total.own, look=look, level=level)
        return Cotangents(of_root.table, own), factor + of_factor + of_root.factor
