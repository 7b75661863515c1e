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
from jaxsph.engine.field.fetch import Block, fetch
from jaxsph.engine.field.sums import in_halves
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.particles import kernels
from jaxsph.numerics.extremes import clamped, greater, lesser
from jaxsph.numerics.fusion import fusion_barrier, side_by_side
from jaxsph.numerics.trees import tree

Carry = TypeVar("Carry")
BLOCK = 16  # particles of each slab, unrolled


def nth_row(number: int) -> Any:
    """A property that is one of `rows` side by side, whose last axis is rays."""
    return property(lambda self: self.rows[..., number, :])


@tree()
class SlabRays:
    """Rays of slabs.

    Attributes:
        rows: what follows but for `middle`, one array such that it is one XLA kernel.
        u, v: lateral coordinates at the middle of the slab; `slope_u`, `slope_v`: a unit of depth.
        square: of their length a unit of depth.
        middle: its depth.
    """

    rows: Float[Array, "tasks 5 rays"]
    middle: Float[Array, "tasks 1"]
    u, v, slope_u, slope_v, square = map(nth_row, range(5))

    @classmethod
    def of(cls, task: SlabTask) -> SlabRays:
        """Of the slabs of a task."""
        u, v = task.ray_coordinates()
        middle = 0.5 * (task.border[:, :1] + task.border[:, -1:])
        none = jnp.zeros_like(u)
        rows = [u * middle, v * middle, u, v, 1 + u * u + v * v] if task.perspective else [u, v, none, none, none + 1]
        return cls(side_by_side(rows, 1), middle)

    def at(self, place: Float[Array, "tasks some rays"]) -> tuple[Float[Array, "tasks some rays"], ...]:
        """View coordinates of points of the rays, by depths relative to the middle."""
        x, y = self.u[:, None] + place * self.slope_u[:, None], self.v[:, None] + place * self.slope_v[:, None]
        return x, y, place + self.middle[:, None]


class Passed(NamedTuple):
    """A block of particles, as rays pass them: feet, what kernels need of the distance there, and of a unit of depth squared."""

    foot: Float[Array, "tasks block rays"]
    nearest: Float[Array, "tasks block rays"]
    rate: Float[Array, "tasks block rays"]


class Bound(NamedTuple):
    """Of the intervals between neighbouring depths.

    Attributes:
        upper: of the field.
        place: where it may be largest: at the foot of the first particle that alone reaches the level, else at the mean of all
            feet, by weight.
    """

    upper: Float[Array, "tasks intervals rays"]
    place: Float[Array, "tasks intervals rays"]


class Found(NamedTuple):
    """The field, its gradient in view space, and quantities relative to the slab's references times weights, at points."""

    weight: Float[Array, "tasks rays"]
    gradient: tuple[Float[Array, "tasks rays"], ...]
    weighted: tuple[Float[Array, "tasks rays"], ...]


@tree(static=("kernel",))
class Piercing:
    """Rays of slabs, and the particles in their windows: `blocks` of them, in the slab whose windows hold most."""

    ordered: Ordered
    rank: Int[Array, " pairs"]
    task: SlabTask
    lines: SlabRays
    blocks: Int[Array, ""]
    kernel: str

    @classmethod
    def of(cls, ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str) -> Piercing:
        """Of the slabs of a task."""
        return cls(ordered, rank, task, SlabRays.of(task), (task.entry.length.sum(0).max() + BLOCK - 1) // BLOCK, kernel)

    def ray(self) -> list[Float[Array, "tasks rays"]]:
        """View coordinates of a vector along each ray, of a unit of depth."""
        return [self.lines.slope_u, self.lines.slope_v, jnp.ones_like(self.lines.u)]

    def bound(self, border: Float[Array, "tasks borders"], level: Float[Array, ""]) -> Bound:
        """Of the field between borders, relative to the middle."""
        smooth = kernels.by_name(self.kernel)

        def of_one(block: Block, passed: Passed, k: int) -> tuple[Array, ...]:
            foot = passed.foot[:, k, None]
            at = _within(foot, border)
            rest = (at - foot) ** 2 * passed.rate[:, k, None]
            weight = smooth.weigh(passed.nearest[:, k, None], rest, block.size[:, k, None, None], jnp)
            return weight, weight * at, jnp.where(weight >= level, at, far)

        def both(a: tuple[Array, ...], b: tuple[Array, ...]) -> tuple[Array, ...]:
            return a[0] + b[0], a[1] + b[1], lesser(a[2], b[2])

        def add(block: Block, passed: Passed, so_far: tuple[Array, ...]) -> tuple[Array, ...]:
            halves = [
                functools.reduce(both, (of_one(block, passed, k) for k in range(first, BLOCK, 2))) for first in (0, 1)
            ]  # in one loop, by a reduction: see `field.sums`
            operands = tuple(jnp.stack(pair) for pair in zip(*halves, strict=True))
            return both(so_far, lax.reduce(operands, (zero, zero, far), both, (0,)))

        zero, far = jnp.zeros((), border.dtype), jnp.asarray(jnp.finfo(border.dtype).max, border.dtype)
        nothing = jnp.zeros((border.shape[0], border.shape[1] - 1, self.lines.u.shape[1]), border.dtype)
        start: tuple[Array, ...] = (nothing, nothing, nothing + far)
        upper, weighed, first = self._over(add, start)
        mean = jnp.where(upper > 0, weighed / jnp.where(upper > 0, upper, 1), border[:, :-1, None])
        return Bound(upper, _within(jnp.where(first < far, first, mean), border))

    def upper(self, border: Float[Array, "tasks borders"]) -> Float[Array, "tasks intervals rays"]:
        """The bound alone, `Bound.upper`."""
        smooth = kernels.by_name(self.kernel)

        def add(block: Block, passed: Passed, total: Array) -> Array:
            for k in range(BLOCK):
                foot = passed.foot[:, k, None]
                rest = (_within(foot, border) - foot) ** 2 * passed.rate[:, k, None]
                total = total + smooth.weigh(passed.nearest[:, k, None], rest, block.size[:, k, None, None], jnp)
            return total

        return self._over(add, jnp.zeros((border.shape[0], border.shape[1] - 1, self.lines.u.shape[1]), border.dtype))

    def weights(self, place: Float[Array, "tasks rays"]) -> Float[Array, "tasks rays"]:
        """The field at one depth of each ray, relative to the middle."""

        def put(nth: Array, total: Array) -> Array:
            for one in _each(self._fetched(nth)[1]):
                total = total + self._of_one(one, self.lines, place)[0]
            return total

        return lax.fori_loop(0, self.blocks, put, jnp.zeros_like(place))

    def found(self, place: Float[Array, "tasks rays"]) -> Found:
        """Field, gradient and quantities at one depth of each ray."""

        def put(nth: Array, total: tuple[Array, ...]) -> tuple[Array, ...]:
            of_block = in_halves([self._of_one(one, self.lines, place) for one in _each(self._fetched(nth)[1])])
            return tuple(old + new for old, new in zip(total, of_block, strict=True))

        nothing = (jnp.zeros_like(place),) * (4 + len(self.task.entry.references))
        weight, *rows = lax.fori_loop(0, self.blocks, put, nothing)
        return Found(weight, tuple(rows[:3]), tuple(rows[3:]))

    def pull(
        self, table: Float[Array, "particles 8"], place: Float[Array, "tasks rays"], of_found: Found
    ) -> tuple[Float[Array, "particles 8"], Float[Array, ""]]:
        """Cotangents of particles, `field.transposed.COLUMNS`, added to `table`, from those of what is `found` at a place.

        Returns:
            The table, and the cotangent of a common factor of all u and v, where the place stays.
        """
        of_rows = jnp.stack([of_found.weight, *of_found.gradient, *of_found.weighted])
        task = self.task

        def rows(columns: tuple[Array, ...], factor: Array) -> Array:
            x, y, z, scale, size, *quantities = columns
            lines = SlabRays.of(dataclasses.replace(task, u=task.u * factor, v=task.v * factor))

            def of_one(one: Block) -> Array:
                return jnp.stack(self._of_one(one, lines, place))

            return jax.vmap(of_one, 1)(Block(x, y, z, scale, size, tuple(quantities))).sum(0)

        def pulled(block: Block) -> tuple[Array, Array]:
            columns = block.x, block.y, block.z, block.scale, block.size, *block.quantities
            of_columns, of_factor = jax.vjp(rows, columns, jnp.ones((), place.dtype))[1](of_rows)
            row = [jnp.where(block.size > 0, column, 0) for column in of_columns]
            row += [jnp.zeros_like(row[0])] * (table.shape[1] - len(row))
            return jnp.stack(row, -1).reshape(-1, table.shape[1]), of_factor

        def put(nth: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            particle, block = self._fetched(nth)
            row, of_factor = fusion_barrier(self.blocks >= 0, pulled, block)
            return carry[0].at[particle.ravel()].add(row, mode="promise_in_bounds"), carry[1] + of_factor

        return lax.fori_loop(0, self.blocks, put, (table, jnp.zeros((), place.dtype)))

    def _of_one(self, one: Block, lines: SlabRays, place: Float[Array, "tasks rays"]) -> list[Float[Array, "tasks rays"]]:
        """What one particle of each slab adds to what is `found`."""
        x, y, z, scale, size, *quantities = (of[:, None] for of in jax.tree.leaves(one))
        smooth = kernels.by_name(self.kernel)
        away = (lines.u + place * lines.slope_u) - x, (lines.v + place * lines.slope_v) - y, place - (z - lines.middle)
        across, along = (away[0] * scale) ** 2, smooth.prepare((away[1] * scale) ** 2 + (away[2] * scale) ** 2, size)
        weight = smooth.weigh(along, across, size, jnp)
        slope = 2 * scale**2 * smooth.slope(along, across, size, jnp)
        return [weight, *(slope * of for of in away), *(weight * of for of in quantities)]

    def _over(self, add: Callable[[Block, Passed, Carry], Carry], start: Carry) -> Carry:
        """All particles of the windows, a block at a time."""

        def put(nth: Array, carry: Carry) -> Carry:
            block = self._fetched(nth)[1]
            return add(block, fusion_barrier(self.blocks >= 0, self._passed, block), carry)

        return lax.fori_loop(0, self.blocks, put, start)

    def _fetched(self, nth: Array) -> tuple[Int[Array, "tasks block"], Block]:
        """The nth block of each slab, by rank and as such."""
        entry = self.task.entry
        windows, references = (entry.begin[..., None], entry.length[..., None]), tuple(one[:, None] for one in entry.references)

        def fetched(nth: Array) -> tuple[Array, Block]:
            return fetch(self.ordered, self.rank, windows, nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32), references)

        return fusion_barrier(self.blocks >= 0, fetched, nth)

    def _passed(self, block: Block) -> Passed:
        """How rays pass a block of particles."""
        lines = self.lines
        x, y = block.x[..., None] - lines.u[:, None], block.y[..., None] - lines.v[:, None]
        z, scale = block.z[..., None] - lines.middle[..., None], block.scale[..., None]
        along = x * lines.slope_u[:, None] + y * lines.slope_v[:, None] + z
        foot = along / lines.square[:, None]
        away = greater(0, (x * x + y * y + z * z) - along * foot)
        nearest = kernels.by_name(self.kernel).prepare(away * scale**2, block.size[..., None])
        return Passed(foot, nearest, scale**2 * lines.square[:, None])


def _within(place: Float[Array, "tasks _ rays"], border: Float[Array, "tasks borders"]) -> Float[Array, "tasks intervals rays"]:
    """The nearest in each interval between borders."""
    return clamped(place, border[:, :-1, None], border[:, 1:, None])


def _each(block: Block) -> list[Block]:
    """Its particles one by one."""
    return [jax.tree.map(lambda of, k=k: of[:, k], block) for k in range(BLOCK)]  # type: ignore[misc]
