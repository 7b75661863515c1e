r"""Cotangents of particles, from those of the sums at samples: the transpose of `field.gather`.

Flow: cotangents of an image -> adjoint -> [transposed] -> cotangents of particles.

A particle's weights at the samples of a slab depend on it by the squared distance $d^2$ and by its size alone. With $\bar w$ the
cotangent of a weight and $g = \bar w \, \partial w / \partial d^2$, all cotangents of a particle follow from six sums over the
samples of the slab: of $g$, $g \Delta x$, $g \Delta y$, $g d^2$, $\bar w w$ and $\bar w_q w$, the last for each quantity. XLA
evaluates every weight anew for each array that it makes, but a reduction of several operands is one loop. The loop is over two
halves, which the compiler writes out, and the rest of the sum is written out here. Shapes, once: slabs come last, so that they
are summed side by side.
"""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.fetch import fetch, with_rows_at
from jaxsph.engine.field.sums import in_halves
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Places
from jaxsph.model.particles import kernels
from jaxsph.numerics.fusion import fusion_barrier

BLOCK = 16  # particles at once
COLUMNS = ("x", "y", "z", "scale", "size", "quantity", "extinction_quantity")  # of particles, that samples depend on; one or two
WIDTH = 8  # of a row of cotangents, one or two of them unused: it fills a vector, and is added as one


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
    of_sums = fusion_barrier(entry.begin[0, 0] >= 0, functools.partial(_slabs_last, shape=shape), of_sums)
    windows = entry.begin[:, None], entry.length[:, None]
    smooth = kernels.by_name(kernel)
    moments_of = _moments_of_scattered if task.scattered else _moments
    sum_up, finish = functools.partial(moments_of, smooth=smooth), functools.partial(_cotangents, degree=smooth.degree)

    def fetched(index: Array) -> tuple[Array, list[Array]]:
        particle, block = fetch(ordered, rank, windows, index, entry.references)
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


def _slabs_last(values: tuple[Array, ...], shape: tuple[int, ...]) -> list[Array]:
    return [jnp.moveaxis(value.reshape(shape), 0, -1) for value in values]


def _moments(
    particles: list[Array], sides: tuple[Array, ...], of_sums: list[Array], *, smooth: kernels.Kernel
) -> tuple[Array, ...]:
    """Sums over the rays of a bundle, (particles, samples, chunk), of what the head of this file lists."""
    x, y, z, scale, size, *quantities = (column[:, :, None] for column in particles)
    su, sv, s = sides
    x_off, y_off = su - x, sv - y
    across, along = (x_off * scale) ** 2, ((s[:, None] - z) * scale) ** 2 + (y_off * scale) ** 2
    always = size[0, 0, 0, 0] >= 0
    operands = x_off, across, along, size, quantities, of_sums
    in_rows = fusion_barrier(always, functools.partial(_along_columns, smooth=smooth), *operands)
    return fusion_barrier(always, _along_rows, in_rows, y_off)


def _moments_of_scattered(
    particles: list[Array], sides: tuple[Array, ...], of_sums: list[Array], *, smooth: kernels.Kernel
) -> tuple[Array, ...]:
    """The same over rays that are no tensor product."""
    x, y, z, scale, size, *quantities = particles
    depth_off = ((sides[2] - z) * scale) ** 2

    def part(r: int) -> list[Array]:
        x_off, y_off = sides[0][:, r] - x, sides[1][:, r] - y
        along, across = depth_off + (y_off * scale) ** 2, (x_off * scale) ** 2
        prepared, (of_weight, *of_weighted) = smooth.prepare(along, size), (of_sum[:, 0, r] for of_sum in of_sums)
        weight, value = smooth.weigh(prepared, across, size, jnp), _value(of_weight, quantities, of_weighted)
        slope = value * smooth.slope(prepared, across, size, jnp)
        of_quantities = [weight * of_sum for of_sum in of_weighted]
        return [slope, slope * x_off, slope * (along + across), value * weight, *of_quantities, slope * y_off]

    return in_halves([part(r) for r in range(of_sums[0].shape[2])])


def _value(of_weight: Array, quantities: list[Array], of_weighted: list[Array]) -> Array:
    """Cotangent of a particle's weight, by all sums."""
    return functools.reduce(jnp.add, (q * of_sum for q, of_sum in zip(quantities, of_weighted, strict=True)), of_weight)


def _along_columns(
    x_off: Array,
    across: Array,
    along: Array,
    size: Array,
    quantities: list[Array],
    of_sums: list[Array],
    *,
    smooth: kernels.Kernel,
) -> tuple[Array, ...]:
    """Of each row of rays, the sums of g, g dx, g d^2, and of weights times their cotangents, in all and through quantities."""
    prepared = smooth.prepare(along, size)

    def part(c: int) -> list[Array]:
        rest, (of_weight, *of_weighted) = across[:, :, c, None], (of_sum[:, :, c] for of_sum in of_sums)
        weight, value = smooth.weigh(prepared, rest, size, jnp), _value(of_weight, quantities, of_weighted)
        slope = value * smooth.slope(prepared, rest, size, jnp)
        of_quantities = [weight * of_sum for of_sum in of_weighted]
        return [slope, slope * x_off[:, :, c, None], slope * (along + rest), value * weight, *of_quantities]

    return in_halves([part(c) for c in range(of_sums[0].shape[2])])


def _along_rows(in_rows: tuple[Array, ...], y_off: Array) -> tuple[Array, ...]:
    """Sums over the rows of what those over the columns are, and of g dy."""
    sums = [*in_rows, in_rows[0] * y_off]
    return in_halves([[value[:, :, r] for value in sums] for r in range(y_off.shape[2])])


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
