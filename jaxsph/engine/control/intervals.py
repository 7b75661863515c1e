r"""Bundles bracketed: between what all pixels of a bundle lie, at any levels of its cells.

Flow: cells, levels -> bounds -> [intervals] -> lower and upper image.

Hochstetter et al. 2016, sections 4.1 to 4.3, equations 3 and 4: bounds of samples are composited to those of a cell, and those
of the cells of a bundle to bounds of its pixels. Back to front, a sample of colour c and transmittance T turns what arrives from
behind, B, into $c (1 - T) + T B$. There are two forms for intervals of c, T and B.

- `"lerp"`: the expression grows with c and with B, and is linear in T, so over independent intervals it is least at the least c
  and B and at one end of T, and greatest alike.
- `"paper"`: irradiance $c (1 - T)$ and transmittance are intervals apart, and $I + T B$ is taken of them (equation 4), which
  forgets that both hold the same T. It is never narrower, and here to compare.

**Theorem.** Colour and alpha of every pixel of a bundle lie between `lower` and `upper`, as they are computed.
*Argument.* By `bounds.sample_bounds` the colour and extinction of each sample, as computed, lie in the ranges that are composited
(colour where a sample is not empty; extinction from 0 where a sample may be empty or a clip may cut; 0 to 1, opaque to clear,
where a medium is that has no bounds). The path of a sample is that of some ray of the bundle; products of extinction, depth and
path are off by less than `DEPTH_ROUNDING` eps, which is added. By induction from behind, exact compositing of these samples lies
in the intervals: alpha is the colour of a light that is 1 everywhere. Every step is rounded outwards by what it can lose: an
exponential `EXPONENTIAL` eps, and four operations on numbers of at most `largest` half an eps each. The pixel itself is
composited front to back, which differs from exact compositing by less than half of `adapt.rounding_of`. $\square$

Error control does not need these bounds (see `errors`): they count how much the rays of a bundle differ even at full rate.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.compaction import fullest_first
from jaxsph.engine.access.grid import CELL_SAMPLES, MAX_LEVEL, Grid, SlabWindows, by_cell
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.control.bounds import EXTINCTION, SampleBounds, cell_bounds, spheres, tables_of_parts
from jaxsph.engine.control.errors import DEPTH_ROUNDING, EXPONENTIAL
from jaxsph.model.camera.camera import Camera
from jaxsph.model.transfer.function import TransferFunction

COMPOSITING = 2  # eps that a step of compositing loses besides the exponential
MIXING = 16  # eps by which colours of several media may exceed the largest of them
Interval = tuple[Float[Array, "4"], Float[Array, "4"]]
"""Least and greatest red, green, blue and alpha of the pixels of a bundle."""


class Rays(NamedTuple):
    """The rays of bundles.

    Attributes:
        u, v: ray coordinates of the columns and, descending, of the rows of pixels.
        shortest, longest: path length a unit of depth.
    """

    u: Float[Array, "8 bundles"]
    v: Float[Array, "8 bundles"]
    shortest: Float[Array, " bundles"]
    longest: Float[Array, " bundles"]


def rays_of_bundles(grid: Grid, camera: Camera, fringe: float = 0) -> Rays:
    """All rays through the pixels of the bundles of a band, as far as `fringe` pixels beside the middles."""
    bundles = grid.windows.count.shape[1]
    u, v = grid.rays(camera, jnp.arange(bundles, dtype=jnp.int32))
    if fringe:  # what bounds are made of are the first and the last ray of every part of a footprint
        beside = 2 * fringe / camera.height * camera.half_height
        side = jnp.where(jnp.arange(BUNDLE) % 2 == 0, -1, 1).astype(u.dtype)[:, None]
        u, v = u + side * beside, v - side * beside
    if not camera.is_perspective:
        path = jnp.ones(bundles, u.dtype)
        return Rays(u, v, path, path)
    nearest, farthest = ([jnp.abs(rays).min(0) for rays in (u, v)], [jnp.abs(rays).max(0) for rays in (u, v)])
    if fringe:  # the axis of view may lie between
        nearest = [
            jnp.where((rays.min(0) <= 0) & (rays.max(0) >= 0), 0, least) for rays, least in zip((u, v), nearest, strict=True)
        ]
    shortest, longest = (jnp.sqrt(1 + side[0] ** 2 + side[1] ** 2) for side in (nearest, farthest))
    return Rays(u, v, shortest, longest)


def bounds_of_cells(
    grid: Grid,
    windows: SlabWindows,
    depths: tuple[Float[Array, " samples"], Float[Array, " samples"]],
    rays: Rays,
    references: list[tuple[Float[Array, "cells bundles"], Float[Array, "cells bundles"]]],
    transfer: TransferFunction | None,
    *,
    slab_samples: int,
    subdivisions: int,
    perspective: bool,
    cells_at_once: int,
) -> SampleBounds:
    """Bounds of the samples of all cells of a band, (cells, 16, bundles).

    Args:
        windows: of slabs, with all particles that can touch a sample at the `depths`, from and to, of each.
        references: of each quantity, the least and the greatest that sums of a cell may be taken relative to.
        transfer: what particles look like; without one they are not seen.
        subdivisions: sub-rectangles on each side of a footprint, for the test of coverage.
    """
    cells = functools.partial(by_cell, slab_samples=slab_samples)
    count = cells(windows.count)
    num_cells, _, bundles = count.shape
    both = [cells(side).reshape(len(side), -1, bundles) for side in (windows.begin, windows.length)]
    balls, number = spheres(grid.ordered), num_cells * bundles
    tables = () if transfer is None else tables_of_parts(transfer)

    def put(table: SampleBounds, at: Array, real: Array) -> SampleBounds:
        cell, bundle = at // bundles, at % bundles
        ends = jax.tree.map(lambda end: end[cell, bundle], references)
        through = rays.u[:, bundle], rays.v[:, bundle]
        sizes = slab_samples, subdivisions, perspective
        bounds = cell_bounds(balls, grid.lists.rank, both, depths, (cell, bundle, real), through, ends, tables, *sizes)
        place = jnp.where(real, at, number)
        return jax.tree.map(lambda rows, new: rows.at[:, place].set(new, mode="drop", unique_indices=True), table, bounds)

    none, zero = jnp.zeros((CELL_SAMPLES, number), bool), jnp.zeros((CELL_SAMPLES, number), grid.half_steps.dtype)
    start = SampleBounds(none, none, [zero] * 4, [zero] * 4)
    wanted, fullest = (count.sum(1) > 0).ravel(), count.max(1).ravel()
    table = start if transfer is None else fullest_first(put, start, wanted, fullest, cells_at_once)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf.reshape(CELL_SAMPLES, num_cells, bundles), 1, 0), table)


def within_clip(bounds: SampleBounds, meets: Bool[Array, "slabs bundles"], holds: Bool[Array, "slabs bundles"]) -> SampleBounds:
    """Of particles that are shown in a clip: slabs that it does not meet are empty, those that it cuts may be."""
    meets, holds = (_over_samples(slabs, bounds) for slabs in (meets, holds))
    return SampleBounds(bounds.touched & meets, bounds.covered & holds, bounds.lo, bounds.hi)


def with_unknown(bounds: SampleBounds, occupied: Bool[Array, "slabs bundles"], largest: float) -> SampleBounds:
    """With media that have no bounds in some slabs: there they may let all light through or none, of any colour."""
    unknown = _over_samples(occupied, bounds)
    opaque = jnp.finfo(bounds.hi[0].dtype).max
    lo = [jnp.where(unknown, 0, least) for least in bounds.lo[:EXTINCTION]]
    hi = [jnp.where(unknown, largest, most) for most in bounds.hi[:EXTINCTION]]
    extinction = jnp.where(unknown, opaque, bounds.hi[EXTINCTION])
    return SampleBounds(bounds.touched | unknown, bounds.covered, [*lo, bounds.lo[EXTINCTION]], [*hi, extinction])


def _over_samples(slabs: Bool[Array, "slabs bundles"], bounds: SampleBounds) -> Bool[Array, "cells 16 bundles"]:
    cells, _, bundles = bounds.touched.shape
    slab_samples = CELL_SAMPLES * cells // slabs.shape[0]
    samples = jnp.repeat(slabs, slab_samples, 0)
    return jnp.pad(samples, ((0, cells * CELL_SAMPLES - samples.shape[0]), (0, 0))).reshape(cells, CELL_SAMPLES, bundles)


def composited(
    bounds: SampleBounds,
    borders: Float[Array, " samples_and_one"],
    rays: Rays,
    levels: Int[Array, "cells bundles"] | None = None,
    *,
    form: str = "lerp",
    largest: float = 1.0,
) -> tuple[Float[Array, "4 bundles"], Float[Array, "4 bundles"]]:
    """Bounds of the pixels of all bundles, from those of the samples of their cells.

    Args:
        bounds: of samples, (cells, 16, bundles); at a level above 0 those of whole slabs, from border to border.
        levels: of every cell, 0 to 4; at full rate if there are none.
        form: `"lerp"`, or `"paper"` for irradiance and transmittance as intervals of their own.
        largest: that a colour can be, as a share of the light that a sample takes.
    """
    first = jnp.arange(bounds.touched.shape[0], dtype=jnp.int32)[:, None] * CELL_SAMPLES
    of_cells = borders[first + jnp.arange(CELL_SAMPLES + 1, dtype=jnp.int32)]

    def of_bundle(bounds: SampleBounds, shortest: Array, longest: Array, levels: Array | None) -> Interval:
        through = functools.partial(_through_cell, path=(shortest, longest), form=form, largest=largest)

        def step(behind: Interval, cell: tuple[SampleBounds, Array, Array | None]) -> tuple[Interval, None]:
            samples, edges, level = cell
            if level is None:
                return through(samples, edges, behind, level=0), None
            options = [through(samples, edges, behind, level=one) for one in range(MAX_LEVEL + 1)]
            lo, hi = (jnp.stack(side) for side in zip(*options, strict=True))
            return (lo[level], hi[level]), None

        nothing = jnp.zeros(4, borders.dtype)
        return lax.scan(step, (nothing, nothing), (bounds, of_cells, levels), reverse=True)[0]

    of_bundles = jax.vmap(of_bundle, in_axes=(-1, -1, -1, None if levels is None else -1), out_axes=-1)
    return of_bundles(bounds, rays.shortest, rays.longest, levels)  # type: ignore[no-any-return]


def _through_cell(
    bounds: SampleBounds,
    edges: Float[Array, "17"],
    behind: Interval,
    *,
    level: int,
    path: tuple[Array, Array],
    form: str,
    largest: float,
) -> Interval:
    """What leaves a cell of one bundle, that is sampled at a level, for what arrives from behind."""
    width, eps = 1 << level, jnp.finfo(edges.dtype).eps
    outward = (EXPONENTIAL + COMPOSITING) * eps * largest
    lo, hi = behind
    for first in range(CELL_SAMPLES - width, -1, -width):
        window = slice(first, first + width)
        touched, depth = bounds.touched[window], edges[first + width] - edges[first]
        thin = jnp.where(bounds.covered[window], bounds.lo[EXTINCTION][window], 0).min()
        thick = jnp.where(touched, bounds.hi[EXTINCTION][window], 0).max()
        clear = jnp.exp(-thin * depth * path[0] * (1 - DEPTH_ROUNDING * eps))
        dim = jnp.exp(-thick * depth * path[1] * (1 + DEPTH_ROUNDING * eps))
        one = jnp.ones_like(clear)
        low = jnp.stack([*(jnp.where(touched, color[window], largest).min() for color in bounds.lo[:EXTINCTION]), one])
        high = jnp.stack([*(jnp.where(touched, color[window], 0).max() for color in bounds.hi[:EXTINCTION]), one])
        if form == "lerp":
            new_lo = jnp.minimum(low * (1 - clear) + clear * lo, low * (1 - dim) + dim * lo)
            new_hi = jnp.maximum(high * (1 - clear) + clear * hi, high * (1 - dim) + dim * hi)
        else:
            new_lo, new_hi = low * (1 - clear) + dim * lo, high * (1 - dim) + clear * hi
        some = touched.any()
        lo, hi = jnp.where(some, new_lo - outward, lo), jnp.where(some, new_hi + outward, hi)
    return lo, hi
