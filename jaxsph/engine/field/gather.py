r"""Sums over particles at all samples of slabs, as a few fat XLA kernels; and their transpose.

Flow: schedule -> [gather] -> media; cotangents of sums -> [gather: pull_gather] -> cotangents of particles.

Marching is thread-coherent as in Hochstetter et al. 2016, section 6.3: blocks of `BLOCK` particles are added to all samples of a
slab at once. Shapes, once: accumulators are (tasks, samples of a slab, rows, columns); backward, slabs come last, so that they
are summed side by side.

The perspective grid makes the squared distance separable. A sample sits at $(a_k u_c, a_k v_r, s_k)$ with $a = s$
(perspective) or 1 (orthographic), so the squared distance in supports is $A_{kc} + D_{kr}$ with $A_{kc} = ((a_k u_c - X) / H)^2$
and $D_{kr} = ((s_k - Z) / H)^2 + ((a_k v_r - Y) / H)^2$: one addition a sample, or for poly6 one subtraction from the margin
$1 - D_{kr}$. Differences to the particle are taken before they are squared, so nothing cancels.

Rays that are no tensor product have the same order of operations, so that a ray is the same bit for bit in whichever packet it is
cast: what rays of a row or a column would share is computed where it is added, but rounded as if it were stored, as a compiler
may contract a square and what it is added to into one operation.

A particle's weights at the samples of a slab depend on it by the squared distance $d^2$ and by its size alone. With $\bar w$ the
cotangent of a weight and $g = \bar w \, \partial w / \partial d^2$, all cotangents of a particle follow from six sums over the
samples of the slab: of $g$, $g \Delta x$, $g \Delta y$, $g d^2$, $\bar w w$ and $\bar w_q w$, the last for each quantity. XLA
evaluates every weight anew for each array that it makes, but a reduction of several operands is one loop. The loop is over two
halves, which the compiler writes out, and the rest of the sum is written out here.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.sums import Sums, fetch, in_halves, particle_at, sums_of, with_block, with_rows_at
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Places
from jaxsph.model.particles import kernels
from jaxsph.numerics.compiled import fusion_barrier, lesser

BLOCK = 16  # particles unrolled in the inner loop, and of one turn backward
PARTS = (8,)  # of the slabs of a task, that have loops of their own
COLUMNS = ("x", "y", "z", "scale", "size", "quantity", "extinction_quantity")  # of particles, that samples depend on; one or two
WIDTH = 8  # of a row of cotangents, one or two of them unused: it fills a vector, and is added as one


def gather(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str) -> Sums:
    """Sums (tasks, samples, rows, columns) at every sample of slabs, from all particles of their windows; scattered, one row."""
    shape = task.shape if task.scattered else (*task.depth.shape, task.v.shape[1], task.u.shape[1])
    add = functools.partial(_add_scattered if task.scattered else _add, ordered, rank, kernel)
    start = sums_of([jnp.zeros(shape, task.depth.dtype)] * (1 + len(ordered.quantities)))
    sums = task.over_blocks(BLOCK, PARTS, add, start)
    return jax.tree.map(lambda value: value[:, :, None], sums) if task.scattered else sums  # type: ignore[no-any-return]


def _add(ordered: Ordered, rank: Int[Array, " pairs"], kernel: str, task: SlabTask, nth: Array, sums: Sums) -> Sums:
    s, smooth = task.depth, kernels.by_name(kernel)
    lateral_scale = s if task.perspective else jnp.ones_like(s)
    su, sv = task.u[:, None, :] * lateral_scale[:, :, None], task.v[:, None, :] * lateral_scale[:, :, None]

    def separate(nth: Array) -> tuple[Array, Array, Array, tuple[Array, ...]]:
        """The two parts of the squared distance, sizes and quantities of a block of particles; size 0 past the last."""
        block = fetch(ordered, *particle_at(rank, *task.nth_block(BLOCK, nth)), task.references)
        x, y, z, scale = (value[:, :, None, None] for value in (block.x, block.y, block.z, block.scale))
        across = ((su[:, None] - x) * scale) ** 2
        along = ((s[:, None, :, None] - z) * scale) ** 2 + ((sv[:, None] - y) * scale) ** 2
        return across, smooth.prepare(along, block.size[:, :, None, None]), block.size, block.quantities

    across, along, size, quantities = fusion_barrier(nth >= 0, separate, nth)

    def weighed(k: int) -> tuple[Array, list[Array]]:
        w = smooth.weigh(along[:, k, :, :, None], across[:, k, :, None, :], size[:, k, None, None, None], jnp)
        return w, [quantity[:, k, None, None, None] for quantity in quantities]

    return with_block(sums, [weighed(k) for k in range(BLOCK)])


def _add_scattered(ordered: Ordered, rank: Int[Array, " pairs"], kernel: str, task: SlabTask, nth: Array, sums: Sums) -> Sums:
    """The same of rays that are no tensor product."""
    s, smooth = task.depth[..., None], kernels.by_name(kernel)
    lateral_scale = s if task.perspective else jnp.ones_like(s)
    su, sv = task.u[:, None] * lateral_scale, task.v[:, None] * lateral_scale
    largest = jnp.finfo(s.dtype).max
    block = fusion_barrier(nth >= 0, lambda: fetch(ordered, *particle_at(rank, *task.nth_block(BLOCK, nth)), task.references))

    def weighed(k: int) -> tuple[Array, tuple[Array, ...]]:
        one = jax.tree.map(lambda column: column[:, k, None, None], block)
        across = lesser(((su - one.x) * one.scale) ** 2, largest)  # what is between the two keeps them apart
        along = ((s - one.z) * one.scale) ** 2 + ((sv - one.y) * one.scale) ** 2
        return smooth.weigh(smooth.prepare(along, one.size), across, one.size, jnp), one.quantities

    return with_block(sums, (weighed(k) for k in range(BLOCK)))


def pull_gather(
    table: Float[Array, "particles 8"],
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    task: SlabTask,
    of_sums: tuple[Float[Array, "tasks samples rays"], ...],
    kernel: str,
) -> tuple[Float[Array, "particles 8"], Places]:
    """Add to `table` the cotangents by the samples of a chunk, from those of their sums; and those of where samples are."""
    u, v, s, entry = task.u.T, task.v.T, task.depth.T, task.entry
    lateral_scale = s if task.perspective else jnp.ones_like(s)
    sides = u * lateral_scale[:, None], v * lateral_scale[:, None], s
    shape = (s.shape[1], s.shape[0], 1 if task.scattered else v.shape[0], u.shape[0])
    of_sums = fusion_barrier(
        entry.begin[0, 0] >= 0, lambda values: [jnp.moveaxis(value.reshape(shape), 0, -1) for value in values], of_sums
    )
    windows = entry.begin[:, None], entry.length[:, None]
    smooth = kernels.by_name(kernel)
    moments_of = _moments_of_scattered if task.scattered else _moments
    sum_up, finish = functools.partial(moments_of, smooth=smooth), functools.partial(_cotangents, degree=smooth.degree)

    def fetched(index: Array) -> tuple[Array, list[Array]]:
        particle, inside = particle_at(rank, *windows, index)
        block = fetch(ordered, particle, inside, entry.references)
        return particle, [column[:, None] for column in (block.x, block.y, block.z, block.scale, block.size, *block.quantities)]

    def add_block(nth: Array, so_far: tuple[Array, ...]) -> tuple[Array, ...]:
        particle, particles = fusion_barrier(nth >= 0, fetched, nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)[:, None])
        moments = fusion_barrier(nth >= 0, sum_up, particles, sides, of_sums)
        row, lateral, along = fusion_barrier(nth >= 0, finish, particles, s, moments)
        return with_rows_at(so_far[0], particle, row), so_far[1] + lateral, so_far[2] + along

    blocks = (entry.length.sum(0).max() + BLOCK - 1) // BLOCK
    # of a common factor of all lateral coordinates of a sample, and of its depth where those stay
    table, lateral, along = lax.fori_loop(0, blocks, add_block, (table, jnp.zeros_like(s), jnp.zeros_like(s)))
    of_depth = along + lateral / s if task.perspective else along  # lateral coordinates are u s and v s
    return table, Places(of_depth.T, jnp.zeros_like(task.border), lateral.sum())


def _moments(
    particles: list[Array], sides: tuple[Array, ...], of_sums: list[Array], *, smooth: kernels.Kernel
) -> tuple[Array, ...]:
    """Sums over the rays of a bundle, (particles, samples, chunk), of what the head of this file lists: columns, then rows."""
    x, y, z, scale, size, *quantities = (column[:, :, None] for column in particles)
    su, sv, s = sides
    x_off, y_off = su - x, sv - y
    across, along = (x_off * scale) ** 2, ((s[:, None] - z) * scale) ** 2 + (y_off * scale) ** 2

    def along_columns(
        x_off: Array, across: Array, along: Array, size: Array, quantities: list[Array], of_sums: list[Array]
    ) -> Any:
        prepared = smooth.prepare(along, size)

        def part(c: int) -> list[Array]:
            rest = across[:, :, c, None]
            slope, weighed = _met(smooth, prepared, rest, size, quantities, [of_sum[:, :, c] for of_sum in of_sums])
            return [slope, slope * x_off[:, :, c, None], slope * (along + rest), *weighed]

        return in_halves([part(c) for c in range(of_sums[0].shape[2])])

    def along_rows(in_rows: tuple[Array, ...], y_off: Array) -> tuple[Array, ...]:
        sums = [*in_rows, in_rows[0] * y_off]
        return in_halves([[value[:, :, r] for value in sums] for r in range(y_off.shape[2])])

    always = size[0, 0, 0, 0] >= 0
    in_rows = fusion_barrier(always, along_columns, x_off, across, along, size, quantities, of_sums)
    return fusion_barrier(always, along_rows, in_rows, y_off)  # type: ignore[no-any-return]


def _moments_of_scattered(
    particles: list[Array], sides: tuple[Array, ...], of_sums: list[Array], *, smooth: kernels.Kernel
) -> tuple[Array, ...]:
    """The same over rays that are no tensor product."""
    x, y, z, scale, size, *quantities = particles
    depth_off = ((sides[2] - z) * scale) ** 2

    def part(r: int) -> list[Array]:
        x_off, y_off = sides[0][:, r] - x, sides[1][:, r] - y
        along, across = depth_off + (y_off * scale) ** 2, (x_off * scale) ** 2
        prepared = smooth.prepare(along, size)
        slope, weighed = _met(smooth, prepared, across, size, quantities, [of_sum[:, 0, r] for of_sum in of_sums])
        return [slope, slope * x_off, slope * (along + across), *weighed, slope * y_off]

    return in_halves([part(r) for r in range(of_sums[0].shape[2])])


def _met(
    smooth: kernels.Kernel, prepared: Array, across: Array, size: Array, quantities: list[Array], of_sums: list[Array]
) -> tuple[Array, list[Array]]:
    """Of particles at samples, g; and weights times their cotangents by all sums, and times those through quantities."""
    of_weight, *of_weighted = of_sums
    weight = smooth.weigh(prepared, across, size, jnp)
    value = functools.reduce(jnp.add, (q * of_sum for q, of_sum in zip(quantities, of_weighted, strict=True)), of_weight)
    return value * smooth.slope(prepared, across, size, jnp), [value * weight, *(weight * of_sum for of_sum in of_weighted)]


def _cotangents(particles: list[Array], s: Array, moments: tuple[Array, ...], *, degree: int) -> tuple[Array, Array, Array]:
    """Cotangents of a block of particles, in rows, and of the samples, from their moments.

    The kernel is homogeneous of degree n in distance and size, so its derivative by size follows from the other (Euler).
    """
    x, y, z, scale, size, *_ = particles
    slope, slope_x, slope_square, of_weight, *of_quantities, slope_y = moments
    depth, twice = s - z, 2 * scale * scale
    in_x, in_y, in_z = (twice * value for value in (slope_x, slope_y, slope * depth))
    solid = size > 0
    inverse_scale, inverse_size = (jnp.where(solid, 1 / jnp.where(solid, value, 1), 0) for value in (scale, size))
    square = jnp.where(solid, slope_square, 0)
    found = [-in_x, -in_y, -in_z, 2 * square * inverse_scale, (degree * of_weight - 2 * square) * inverse_size]
    found += of_quantities
    row = [jnp.where(solid[:, 0], value.sum(1), 0) for value in found]
    row += [jnp.zeros_like(row[0])] * (WIDTH - len(row))
    # sum of dx u s + dy v s, as u s = dx + x: the cotangent of a common factor of u and v
    lateral = 2 * square - depth * in_z + x * in_x + y * in_y
    return jnp.stack(row, -1), jnp.where(solid, lateral, 0).sum(0), jnp.where(solid, in_z, 0).sum(0)
