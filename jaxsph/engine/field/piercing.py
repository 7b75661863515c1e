r"""The weights of particles along single rays, at depths that each ray has for itself: where fields are bounded and searched.

Flow: schedule -> [piercing] -> particle_surface.

A ray passes a particle at the distance b, nearest at its *foot*; at the depth t their squared distance is
$b^2 + (t - t_{foot})^2 |d|^2$, so with feet found once each weight takes one square more. Depths are relative to the middle of a
slab, and positions to where each ray is there, such that nothing large cancels.

A kernel falls with distance. So between two depths a particle weighs most at its foot, or at the end that is nearer to it, and
the sum of these largest weights bounds the field in between from above, but for the rounding of either sum.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.sums import Block, fetch, in_halves, particle_at, with_rows_at
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.particles import kernels
from jaxsph.numerics.compiled import clamped, fusion_barrier, greater, lesser, side_by_side
from jaxsph.numerics.trees import tree

Carry = TypeVar("Carry")
BLOCK = 16  # particles of each slab, unrolled


def nth_row(number: int) -> Any:
    """A property that is one of `rows` side by side, whose last axis is rays."""
    return property(lambda self: self.rows[..., number, :])


class Found(NamedTuple):
    """The field, its gradient in view space, and quantities relative to the slab's references times weights, at points."""

    weight: Float[Array, "tasks rays"]
    gradient: tuple[Float[Array, "tasks rays"], ...]
    weighted: tuple[Float[Array, "tasks rays"], ...]


@tree(static=("kernel",))
class Piercing:
    """Rays of slabs, and the particles in their windows: `blocks` of them, in the slab whose windows hold most.

    Attributes:
        rows: what follows but for `middle`, one array such that it is one XLA kernel.
        u, v: lateral coordinates at the middle of the slab; `slope_u`, `slope_v`: a unit of depth.
        square: of their length a unit of depth.
        middle: its depth, from which on depths of rays are counted.
    """

    rows: Float[Array, "tasks 5 rays"]
    middle: Float[Array, "tasks 1"]
    u, v, slope_u, slope_v, square = map(nth_row, range(5))
    ordered: Ordered
    rank: Int[Array, " pairs"]
    task: SlabTask
    blocks: Int[Array, ""]
    kernel: str

    @classmethod
    def through(cls, ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str) -> Piercing:
        """Of the slabs of a task."""
        u, v = task.ray_coordinates()
        middle, none = 0.5 * (task.border[:, :1] + task.border[:, -1:]), jnp.zeros_like(u)
        rows = [u * middle, v * middle, u, v, 1 + u * u + v * v] if task.perspective else [u, v, none, none, none + 1]
        blocks = (task.entry.length.sum(0).max() + BLOCK - 1) // BLOCK
        return cls(side_by_side(rows, 1), middle, ordered, rank, task, blocks, kernel)

    def at(self, place: Float[Array, "tasks some rays"]) -> tuple[Float[Array, "tasks some rays"], ...]:
        """View coordinates of points of the rays, by depths."""
        x, y = self.u[:, None] + place * self.slope_u[:, None], self.v[:, None] + place * self.slope_v[:, None]
        return x, y, place + self.middle[:, None]

    def ray(self) -> list[Float[Array, "tasks rays"]]:
        """View coordinates of a vector along each ray, of a unit of depth."""
        return [self.slope_u, self.slope_v, jnp.ones_like(self.u)]

    def bound(
        self, border: Float[Array, "tasks borders"], level: Float[Array, ""]
    ) -> tuple[Float[Array, "tasks intervals rays"], Float[Array, "tasks intervals rays"]]:
        """Of the field between neighbouring borders; and where it may be largest.

        That is at the foot of the first particle that alone reaches the level, else at the mean of all feet, by weight.
        """

        def of_one(passed: tuple[Array, ...], k: int) -> tuple[Array, ...]:
            at, weight = self._most(passed, k, border)
            return weight, weight * at, jnp.where(weight >= level, at, far)

        def both(a: tuple[Array, ...], b: tuple[Array, ...]) -> tuple[Array, ...]:
            return a[0] + b[0], a[1] + b[1], lesser(a[2], b[2])

        def add(_: Array, block: Block, so_far: tuple[Array, ...]) -> tuple[Array, ...]:
            passed = self._passed(block)  # in one loop, by a reduction: see `field.sums`
            halves = [functools.reduce(both, (of_one(passed, k) for k in range(first, BLOCK, 2))) for first in (0, 1)]
            operands = tuple(jnp.stack(pair) for pair in zip(*halves, strict=True))
            return both(so_far, lax.reduce(operands, (zero, zero, far), both, (0,)))

        zero, far = jnp.zeros((), border.dtype), jnp.asarray(jnp.finfo(border.dtype).max, border.dtype)
        nothing = self._nothing(border)
        start: tuple[Array, ...] = (nothing, nothing, nothing + far)
        upper, weighed, first = self._over(add, start)
        mean = jnp.where(upper > 0, weighed / jnp.where(upper > 0, upper, 1), border[:, :-1, None])
        return upper, _within(jnp.where(first < far, first, mean), border)

    def _feet(self, block: Block) -> tuple[Array, Array]:
        """Where rays pass a block of particles, and how far away, squared."""
        x, y, z = (of[..., None] - at[:, None] for of, at in ((block.x, self.u), (block.y, self.v), (block.z, self.middle)))
        along = x * self.slope_u[:, None] + y * self.slope_v[:, None] + z
        foot = along / self.square[:, None]
        return foot, greater(0, (x * x + y * y + z * z) - along * foot)

    def _passed(self, block: Block) -> tuple[Array, ...]:
        """Of a block of particles feet, what kernels need of the distance there and of a unit of depth squared, and sizes."""

        def passed(block: Block) -> tuple[Array, ...]:
            (foot, away), scale = self._feet(block), block.scale[..., None]
            nearest = kernels.by_name(self.kernel).prepare(away * scale**2, block.size[..., None])
            return foot, nearest, scale**2 * self.square[:, None]

        return *fusion_barrier(self.blocks >= 0, passed, block), block.size[..., None]

    def _most(self, passed: tuple[Array, ...], k: int, border: Float[Array, "tasks borders"]) -> tuple[Array, Array]:
        """Where the kth particle of a block weighs most between borders, and how much."""
        foot, nearest, rate, size = (of[:, k, None] for of in passed)
        at = _within(foot, border)
        return at, kernels.by_name(self.kernel).weigh(nearest, (at - foot) ** 2 * rate, size, jnp)

    def _nothing(self, border: Float[Array, "tasks borders"]) -> Float[Array, "tasks intervals rays"]:
        return jnp.zeros((border.shape[0], border.shape[1] - 1, self.rows.shape[2]), border.dtype)

    def weights(self, place: Float[Array, "tasks rays"]) -> Float[Array, "tasks rays"]:
        """The field at one depth of each ray."""

        def add(_: Array, block: Block, total: Array) -> Array:
            return functools.reduce(jnp.add, (self._of_one(one, place)[0] for one in _each(block)), total)

        return self._over(add, jnp.zeros_like(place))

    def found(self, place: Float[Array, "tasks rays"]) -> Found:
        """Field, gradient and quantities at one depth of each ray."""

        def add(_: Array, block: Block, total: tuple[Array, ...]) -> tuple[Array, ...]:
            of_block = in_halves([self._of_one(one, place) for one in _each(block)])
            return tuple(old + new for old, new in zip(total, of_block, strict=True))

        start: tuple[Array, ...] = (jnp.zeros_like(place),) * (4 + len(self.task.entry.references))
        weight, *rows = self._over(add, start)
        return Found(weight, tuple(rows[:3]), tuple(rows[3:]))

    def pull(
        self, table: Float[Array, "particles 8"], place: Float[Array, "tasks rays"], of_found: Found
    ) -> tuple[Float[Array, "particles 8"], Float[Array, ""]]:
        """Cotangents of particles, `field.gather.COLUMNS`, added to `table`, from those of what is `found` at a place.

        Returns:
            The table, and the cotangent of a common factor of all u and v, where the place stays.
        """
        of_rows = jnp.stack([of_found.weight, *of_found.gradient, *of_found.weighted])

        def rows(columns: tuple[Array, ...], factor: Array) -> Array:
            x, y, z, scale, size, *quantities = columns
            rays = Piercing.through(self.ordered, self.rank, self.task.stretched(factor), self.kernel)
            some = Block(x, y, z, scale, size, tuple(quantities))
            return jax.vmap(lambda one: jnp.stack(rays._of_one(one, place)), 1)(some).sum(0)

        def pulled(block: Block) -> tuple[tuple[Array, ...], Array]:
            columns = block.x, block.y, block.z, block.scale, block.size, *block.quantities
            of_columns, of_factor = jax.vjp(rows, columns, jnp.ones((), place.dtype))[1](of_rows)
            return tuple(jnp.where(block.size > 0, column, 0) for column in of_columns), of_factor

        def add(particle: Array, block: Block, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            of_columns, of_factor = fusion_barrier(self.blocks >= 0, pulled, block)
            return with_rows_at(carry[0], particle, of_columns), carry[1] + of_factor

        return self._over(add, (table, jnp.zeros((), place.dtype)))

    def _of_one(self, one: Block, place: Float[Array, "tasks rays"]) -> list[Float[Array, "tasks rays"]]:
        """What one particle of each slab adds to what is `found`."""
        x, y, z, scale, size, *quantities = (of[:, None] for of in jax.tree.leaves(one))
        smooth = kernels.by_name(self.kernel)
        away = (self.u + place * self.slope_u) - x, (self.v + place * self.slope_v) - y, place - (z - self.middle)
        across, along = (away[0] * scale) ** 2, smooth.prepare((away[1] * scale) ** 2 + (away[2] * scale) ** 2, size)
        weight = smooth.weigh(along, across, size, jnp)
        slope = 2 * scale**2 * smooth.slope(along, across, size, jnp)
        return [weight, *(slope * of for of in away), *(weight * of for of in quantities)]

    def _over(self, add: Callable[[Array, Block, Carry], Carry], start: Carry) -> Carry:
        """All particles of the windows, a block of each slab at a time: `add(particle, block, carry)`."""

        def read(nth: Array) -> tuple[Array, Block]:
            particle, inside = particle_at(self.rank, *self.task.nth_block(BLOCK, nth))
            return particle, fetch(self.ordered, particle, inside, self.task.references)

        def put(nth: Array, carry: Carry) -> Carry:
            particle, block = fusion_barrier(self.blocks >= 0, read, nth)
            return add(particle, block, carry)

        return lax.fori_loop(0, self.blocks, put, start)


def upper_of_packets(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str) -> Float[Array, " tasks"]:
    """Bound of the field in slabs, on all of their rays and between them: by the one in the middle.

    At each depth all lie within some distance of that; so by the triangle inequality none is nearer to a particle than the ray in
    the middle is, less that distance.
    """
    (left, right), (low, high) = ((of.min(1, keepdims=True), of.max(1, keepdims=True)) for of in (task.u, task.v))
    rays = Piercing.through(ordered, rank, dataclasses.replace(task, u=0.5 * (left + right), v=0.5 * (low + high)), kernel)
    beside = (0.5 * jnp.hypot(right - left, high - low) * (task.border[:, -1:] if task.perspective else 1))[..., None]
    front, back = ((task.border[:, k, None] - rays.middle)[..., None] for k in (0, -1))
    smooth = kernels.by_name(kernel)

    def add(_: Array, block: Block, total: Array) -> Array:
        (foot, away), size, scale = rays._feet(block), block.size[..., None], block.scale[..., None]
        nearest = jnp.sqrt(away + (clamped(foot, front, back) - foot) ** 2 * rays.square[:, None])
        square = (greater(0, nearest - beside) * scale) ** 2
        return total + smooth.weigh(smooth.prepare(square, size), 0, size, jnp).sum((1, 2))

    return rays._over(add, jnp.zeros_like(task.border[:, 0]))


def _within(place: Float[Array, "tasks _ rays"], border: Float[Array, "tasks borders"]) -> Float[Array, "tasks intervals rays"]:
    """The nearest in each interval between borders."""
    return clamped(place, border[:, :-1, None], border[:, 1:, None])


def _each(block: Block) -> list[Block]:
    return [jax.tree.map(lambda of, k=k: of[:, k], block) for k in range(BLOCK)]  # type: ignore[misc]
