r"""How much a cell's light can change when it is sampled more coarsely: Hochstetter et al. 2016, sections 4.2, 5, made additive.

Flow: bounds -> [errors] -> adapt -> cast -> image.

Replace windows of fine samples by coarse ones, one window at a time, from the back to the front. What the reference lets
through from in front of the window is at most F, and what arrives from behind is some colour B in [0, 1]. With
$\bar c = \sum c_i \Delta T_i / (1 - T)$ the light that leaves the window is $\bar c (1 - T) + T B$, so against a coarse sample
$(c, T')$ it changes by

$$\left| \sum_i (c_i - c) \Delta T_i + (T - T')(B - c) \right|
  \le \sum_i F_i (1 - e^{-\tau_i}) |c_i - c| + F |T - T'|,$$

and $|T - T'| \le T_{max} (1 - e^{-|\tau - \tau'|})$. Changes of windows add up, so the change of a pixel is at most the sum over
the cells of its bundle. A cell left at level 0 adds nothing, however much its rays differ: this is what the paper's relaxation
removes without proof. Alpha is the channel with c = 1 and B = alpha of what lies behind.

Super-pixels (5.2) are decided slab by slab: a *painted* slab is one more coarse sample, as long as the slab, of a colour c and an
extinction that are chosen from the bounds, the same for all rays.

**Theorem.** Painted slabs add what the inequality says with slabs for windows, whichever others are painted, and a run of slabs
of one paint may be composited as one. *Argument.* The inequality asks of c, T' and B no more than that c and B lie in [0, 1]: so
slabs may be replaced back to front, one by one, by any paint whose colour is at most 1. Within a slab the shares telescope,
$\sum_i F_i (1 - e^{-\tau_i}) = F (1 - e^{-\sum_i \tau_i})$: a paint that is off by at most d of each sample's colour changes
what the slab emits by at most $d F (1 - e^{-\tau})$, so that one range of a slab would serve all its samples, and rounding paints
by d costs d of a whole ray at most. Two neighbours of one paint emit $c (1 - T_1) + T_1 c (1 - T_2) = c (1 - T_1 T_2)$ and let
through $T_1 T_2 = e^{-\kappa (s_1 + s_2)}$: what one slab as long as both does. $\square$

In floating point, a run has one thickness, of one difference of depths, three products and a root: within `DEPTH_ROUNDING` eps of
what its slabs have, of which each has that much in its error; and one exponential, where its slabs may be off by one each.

The terms take upper bounds of $|c_i - c|$ and $|\kappa_i - \kappa|$ from `bounds`: a coarse sample lies on the border of its
two middle slabs, so its optics lie in the ranges of both.

Cells are analysed one by one, as if nothing lay in front of them; what does is then a product along the bundle. So
promising cells can be taken in any order: fullest first, some at a time, wherever they are.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxsph.engine.access.compaction import fullest_first
from jaxsph.engine.access.grid import CELL_SAMPLES, MAX_LEVEL, Grid, SlabWindows, by_cell
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.access.precision import sum_rounding
from jaxsph.engine.control.bounds import RangeTables, SampleBounds, cell_bounds, spheres
from jaxsph.engine.control.decide import Limits
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.compiled import fusion_barrier, mantissa_and_exponent, power_of_two
from jaxsph.numerics.trees import tree

LEVELS = MAX_LEVEL + 1
SUPER_PIXEL = LEVELS  # the candidate after the last level: some of the cell's slabs are painted
CANDIDATES = LEVELS + 1
EXPONENTIAL = 2  # eps that a computed transmittance may be off: 2 ulp of the exponential, 3 half ulp of its argument
DEPTH_ROUNDING = 32  # eps that a sum of 16 optical thicknesses, each three roundings off, stays within
FINENESS = (
    8  # binary digits of the tolerance that paints are rounded to: with 3 to 8, 32,000 slabs merge into 4,250 to 4,300 runs
)
EVALUATION = 512  # roundings, at most, between the bounds and an error; all terms are >= 0, so that they stay relative


def fits(slab_samples: int) -> int:
    """The level at which a cell is one slab; beyond it, cells are merged."""
    return (CELL_SAMPLES // slab_samples).bit_length() - 1


class Candidates(NamedTuple):
    """Something of all that cells can be given: levels 0 to 4, and paint for each of their slabs."""

    levels: Shaped[Array, "levels *cells"]
    slabs: Shaped[Array, "slabs_of_a_cell *cells"]


@tree()
class CellErrors:
    """Of single cells and slabs: as seen from right in front of them, or by the bundle's pixels.

    Attributes:
        error: of candidates, how much the light that is seen of the cell or the slab can change; ascends with the level. An
            estimate if relaxed, else a bound.
        strict: of levels, the same, never relaxed, as that of paint is.
        paint: red, green, blue and extinction.
        tau_lo: least optical thickness of slabs.
    """

    error: Candidates
    strict: Float[Array, "levels *cells"]
    paint: Float[Array, "4 slabs_of_a_cell *cells"]
    tau_lo: Float[Array, "slabs_of_a_cell *cells"]


@tree()
class _Optics:
    """Ranges of what the fine samples of a layer of cells are, and of the light that they take away of what enters their slab."""

    color: list[tuple[Array, Array]]
    extinction: tuple[Array, Array]
    steps: Array
    tau_lo: Array
    front: Array
    absorbed_lo: Array
    absorbed_hi: Array


def cell_errors(
    bounds: SampleBounds,
    borders: Float[Array, "samples_and_one bundles"],
    shortest: Float[Array, " bundles"],
    longest: Float[Array, " bundles"],
    merging: tuple[Float[Array, " bundles"], Float[Array, " bundles"]],
    limits: Limits,
    *,
    fitting: int,
) -> CellErrors:
    """Errors of all candidates of cells.

    Args:
        bounds: of the 16 sample slabs of each cell.
        borders: depths of their borders.
        shortest, longest: path length a unit of depth of the bundle's rays.
        merging: by how much colour and extinction of a sample can be rounded otherwise when cells are merged.
        limits: how finely paints are rounded, and what share of the lateral variation is taken off (section 5.1), in cells that
            are nowhere partly empty; 0 for a certificate.
        fitting: level beyond which cells are merged.
    """
    steps, relax = borders[1:] - borders[:-1], limits.relax
    slabs = _optics(bounds, steps, shortest, longest, 1 << fitting)
    outward, quantum = _outward(borders), _fineness(limits)
    of_slabs = jax.tree.map(functools.partial(_by_slab, slabs=1 << fitting), slabs)
    paint, painted = _paint(of_slabs, shortest, longest, quantum, CELL_SAMPLES >> fitting)
    tau_lo = added_up(_by_slab(slabs.tau_lo, 1 << fitting))
    before = jnp.repeat(jnp.exp(-_in_front(tau_lo)), CELL_SAMPLES >> fitting, 0)
    optics = dataclasses.replace(slabs, front=before * slabs.front, absorbed_hi=before * slabs.absorbed_hi)

    rounding = merging[0] * optics.absorbed_hi.sum(0) + merging[1] * optics.steps.sum(0) * longest
    whole = (bounds.covered | ~bounds.touched).all(0)

    def of_levels(share: Array) -> Array:
        errors = [jnp.zeros_like(longest)]
        for level in range(1, LEVELS):
            error = _coarser(level, optics, shortest, longest, share) + (rounding if level > fitting else 0)
            errors.append(jnp.maximum(errors[-1], error))
        return jnp.stack(errors) * outward

    strict = of_levels(jnp.zeros_like(relax))
    error = jnp.where(whole, lax.cond(relax > 0, of_levels, lambda _: strict, relax), strict)
    return CellErrors(Candidates(error, painted * outward), strict, paint, tau_lo)


def paint_errors(
    bounds: SampleBounds,
    lengths: Float[Array, " slabs"],
    shortest: Float[Array, " slabs"],
    longest: Float[Array, " slabs"],
    limits: Limits,
    slab_samples: int,
) -> tuple[Float[Array, " slabs"], Float[Array, "4 slabs"], Float[Array, " slabs"]]:
    """Errors of slabs of `slab_samples` that are painted, seen from right in front of each; paint, and least optical thickness.

    Args:
        bounds: one row, that serves all samples of each slab.
        lengths: of slabs, in depth.
        shortest, longest: path length a unit of depth of the rays of each slab's bundle.
        limits: how finely paints are rounded.
    """
    optics = _optics(bounds, lengths[None], shortest, longest, 1)
    paint, error = _paint(optics, shortest, longest, _fineness(limits), slab_samples)
    return error * _outward(lengths), paint, optics.tau_lo[0]


def _outward(like: Array) -> float:
    return 1 + EVALUATION * float(jnp.finfo(like.dtype).eps)


def _fineness(limits: Limits) -> Array:
    """What paints are rounded to multiples of: a power of two."""
    return power_of_two(mantissa_and_exponent(limits.tolerance)[1] - FINENESS, limits.tolerance.dtype)


def _by_slab(value: Float[Array, "16 cells"], slabs: int) -> Float[Array, "samples slabs cells"]:
    """Of samples of cells, those of each of so many slabs."""
    return value.reshape(slabs, -1, value.shape[-1]).swapaxes(0, 1)


def _in_front(depth: Array) -> Array:
    """What lies in front of each of what follows another along the first axis."""
    return jnp.stack(list(itertools.accumulate(depth[:-1], initial=jnp.zeros_like(depth[0]))))


def _optics(bounds: SampleBounds, steps: Array, shortest: Array, longest: Array, slabs: int) -> _Optics:
    extinction = jnp.where(bounds.covered, bounds.lo[3], 0), jnp.where(bounds.touched, bounds.hi[3], 0)
    color = [_filled(lo, hi, bounds.touched) for lo, hi in zip(bounds.lo[:3], bounds.hi[:3], strict=True)]
    rounding = DEPTH_ROUNDING * jnp.finfo(steps.dtype).eps
    tau_lo, tau_hi = extinction[0] * steps * shortest * (1 - rounding), extinction[1] * steps * longest * (1 + rounding)
    in_front = [_in_front(_by_slab(depth, slabs)).swapaxes(0, 1).reshape(depth.shape) for depth in (tau_lo, tau_hi)]
    front_hi, front_lo = (jnp.exp(-depth) for depth in in_front)
    absorbed_hi, absorbed_lo = front_hi * _opacity(tau_hi), front_lo * jnp.maximum(_opacity(tau_lo) - 2 * _rounding(tau_lo), 0)
    return _Optics(color, extinction, steps, tau_lo, front_hi, absorbed_lo, absorbed_hi)


def _filled(lo: Array, hi: Array, touched: Array) -> tuple[Array, Array]:
    """An empty slab has no colour, and takes no light; let its range be that of the others, so that it never counts."""
    lowest, highest = jnp.where(touched, lo, 1).min(0), jnp.where(touched, hi, 0).max(0)
    return jnp.where(touched, lo, jnp.minimum(lowest, highest)), jnp.where(touched, hi, highest)


def _opacity(depth: Array) -> Array:
    """At least 1 - exp(-depth), and by no more than its rounding: cheaper than `expm1`."""
    return jnp.minimum(1 - jnp.exp(-depth) + _rounding(depth), depth)


def _rounding(like: Array) -> Array:
    """How far a computed transmittance may be off."""
    return jnp.asarray(EXPONENTIAL * jnp.finfo(like.dtype).eps, like.dtype)


def _coarser(level: int, optics: _Optics, shortest: Array, longest: Array, relax: Array) -> Array:
    """Error of a cell sampled at `level`, seen from right in front of it."""
    width = 1 << level
    middle = slice(width // 2 - 1, width // 2 + 1)

    def windows(value: Array) -> Array:
        return value.reshape(CELL_SAMPLES // width, width, -1)

    def deviation(lo: Array, hi: Array) -> Array:
        """How far a fine sample can be from the coarse one, which lies in the ranges of both middle slabs.

        The ranges may be disjoint only if the coarse sample is empty, when it may be given any colour.
        """
        lo, hi = windows(lo), windows(hi)
        ends = lo[:, middle].max(1, keepdims=True), hi[:, middle].min(1, keepdims=True)
        low, high = jnp.minimum(*ends), jnp.maximum(*ends)
        strict = jnp.maximum(hi - low, high - lo)
        union = jnp.maximum(hi.max(1, keepdims=True) - lo, hi - lo.min(1, keepdims=True))
        return jnp.minimum(strict, jnp.maximum(union - relax * (hi - lo), 0))

    steps, least = windows(optics.steps), windows(optics.extinction[0])
    off = jnp.stack([(deviation(*channel) * windows(optics.absorbed_hi)).sum(1) for channel in optics.color]).max(0)
    off_depth = (deviation(*optics.extinction) * steps).sum(1) * longest
    coarse = least[:, middle].max(1) * steps.sum(1) * shortest * (1 - DEPTH_ROUNDING * jnp.finfo(steps.dtype).eps)
    thinnest = jnp.minimum(windows(optics.tau_lo).sum(1), coarse)
    lost = jnp.exp(-thinnest) * _opacity(off_depth)
    rounding = (width + 1) * _rounding(steps) * (windows(optics.extinction[1]).max(1) > 0)
    return (off + windows(optics.front)[:, 0] * (lost + rounding)).sum(0)


def _paint(optics: _Optics, shortest: Array, longest: Array, quantum: Array, samples: int) -> tuple[Array, Array]:
    """The paint that suits slabs best (section 5.2), and their errors seen from right in front of each.

    Its optical thickness is that of the middles of the samples' ranges, and its colour what the middles add up to: of the
    colours' differences along depth only as much counts as the light that each sample takes is uncertain. Rounded to multiples
    of `quantum` (a power of two, that 1 is one of), that slabs which are about alike are painted alike. `samples` are those of a
    slab.
    """
    eps = jnp.finfo(optics.steps.dtype).eps
    lo, hi = optics.extinction
    depth = added_up(optics.steps)
    middle = added_up(0.5 * (lo + hi) * optics.steps) / jnp.where(depth > 0, depth, 1)
    mantissa, exponent = mantissa_and_exponent(middle)
    extinction = _rounded(mantissa, quantum) * power_of_two(exponent, middle.dtype)
    off_depth = (
        added_up(0.5 * (hi - lo) * optics.steps) + (jnp.abs(extinction - middle) + DEPTH_ROUNDING * eps * extinction) * depth
    )
    absorbed, unsure = 0.5 * (optics.absorbed_lo + optics.absorbed_hi), 0.5 * (optics.absorbed_hi - optics.absorbed_lo)
    total = added_up(absorbed)
    paint, off = [], []
    for lo, hi in optics.color:
        middle = 0.5 * (lo + hi)
        mean = jnp.clip(added_up(middle * absorbed) / jnp.where(total > 0, total, 1), 0, 1)
        chosen = _rounded(mean, quantum)
        paint.append(chosen)
        uneven = jnp.abs(middle - mean) * (unsure + DEPTH_ROUNDING * eps * absorbed)
        each = 0.5 * (hi - lo) + DEPTH_ROUNDING * eps * mean + jnp.abs(chosen - mean)
        off.append(added_up(each * optics.absorbed_hi + uneven))
    thinnest = jnp.minimum(added_up(optics.tau_lo), extinction * depth * shortest * (1 - DEPTH_ROUNDING * eps))
    lost = jnp.exp(-thinnest) * _opacity(off_depth * longest)
    rounding = (samples + 1) * _rounding(depth) * (functools.reduce(jnp.maximum, optics.extinction[1]) > 0)
    return jnp.stack([*paint, extinction]), functools.reduce(jnp.maximum, off) + lost + rounding


def added_up(value: Shaped[Array, "few *any"]) -> Shaped[Array, "*any"]:
    """Sum over a short first axis, one by one: XLA's loops over it would not fill registers."""
    return functools.reduce(jnp.add, value)


def _rounded(value: Array, quantum: Array) -> Array:
    """The nearest multiple of a power of two; of 0 the value itself."""
    return jnp.where(quantum > 0, jnp.round(value / jnp.where(quantum > 0, quantum, 1)) * quantum, value)


def analyse(
    grid: Grid,
    beside: SlabWindows,
    camera: Camera,
    references: tuple[Float[Array, "slabs bundles"], ...],
    wanted: Bool[Array, "cells bundles"],
    tables: tuple[RangeTables, ...],
    limits: Limits,
    slab_samples: int,
    coverage_subdivisions: int,
    cells_at_once: int,
) -> CellErrors:
    """Errors of the `wanted` cells of a band, as the bundle's pixels see them; infinite where nothing is analysed.

    Args:
        beside: windows of the slabs with their borders, as coarse samples lie on those.
        references: quantities that each slab's sums are taken relative to.
        tables: of the parts of the transfer function.
        limits: see `cell_errors`.
        coverage_subdivisions: sub-rectangles on each side of a footprint, for the test of coverage.
    """
    cells = functools.partial(by_cell, slab_samples=slab_samples)
    count, filled = cells(beside.count), cells(grid.windows.count > 0)
    num_cells, _, bundles = count.shape
    windows = [cells(side).reshape(len(side), -1, bundles) for side in (beside.begin, beside.length)]
    of_cells = [_extremes(cells(one), filled, 1) for one in references]
    merging = _merging(count.sum(1).ravel(), [_extremes(one, grid.ordered.live) for one in grid.ordered.quantities], tables)
    borders, balls = grid.borders(num_cells * CELL_SAMPLES), spheres(grid.ordered)
    slabs = borders[:-1], borders[1:]
    errors = functools.partial(cell_errors, fitting=fits(slab_samples))

    def analyse_some(table: CellErrors, at: Array, real: Array) -> CellErrors:
        cell, bundle = at // bundles, at % bundles
        u, v = grid.rays(camera, bundle)
        sizes = slab_samples, coverage_subdivisions, camera.is_perspective
        ends = jax.tree.map(lambda end: end[cell, bundle], of_cells)
        bounds = cell_bounds(balls, grid.lists.rank, windows, slabs, (cell, bundle, real), (u, v), ends, tables, *sizes)
        edges = borders[cell * CELL_SAMPLES + jnp.arange(CELL_SAMPLES + 1, dtype=jnp.int32)[:, None]]
        paths = jnp.ones((BUNDLE, BUNDLE, at.shape[0]), edges.dtype)
        if camera.is_perspective:
            paths = jnp.sqrt(1 + u[:, None] ** 2 + v**2)
        path, rounding = (paths.min((0, 1)), paths.max((0, 1))), tuple(one[at] for one in merging)
        found = fusion_barrier(at[0] >= 0, errors, bounds, edges, *path, rounding, limits)
        place = jnp.where(real, at, num_cells * bundles)
        return jax.tree.map(lambda rows, new: rows.at[..., place].set(new, mode="drop", unique_indices=True), table, found)

    # what is not analysed stays at level 0: the only candidate without an infinite error
    number, per_cell = num_cells * bundles, CELL_SAMPLES // slab_samples
    nothing = jnp.zeros((4, per_cell, number), grid.ordered.x.dtype)
    error = jnp.full((LEVELS, number), jnp.inf, nothing.dtype).at[0].set(0)
    start = CellErrors(Candidates(error, jnp.full_like(nothing[0], jnp.inf)), error, nothing, nothing[0])
    table = fullest_first(analyse_some, start, wanted.ravel(), count.max(1).ravel(), cells_at_once)
    found: CellErrors = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], num_cells, bundles), table)
    return as_seen(found)


def as_seen(found: CellErrors) -> CellErrors:
    """Errors by the bundle's pixels, of those seen from right in front of cells and slabs."""
    num_cells = found.tau_lo.shape[1]
    # at least what cells in front let through, as computed: the sum is rounded down, the result up
    eps = jnp.finfo(found.tau_lo.dtype).eps
    of_cells = added_up(found.tau_lo)
    _, before = lax.scan(lambda total, own: (total + own, total), jnp.zeros_like(of_cells[0]), of_cells)
    before = before + _in_front(found.tau_lo)
    # each sample's computed transmittance may be larger than the exponential by a few roundings, and products round too
    more = 1 + (EXPONENTIAL + 1) * CELL_SAMPLES * num_cells * eps
    front = jnp.exp(-before * (1 - (num_cells + CELL_SAMPLES) * eps)) * more
    seen = Candidates(front[0] * found.error.levels, front * found.error.slabs)
    return dataclasses.replace(found, error=seen, strict=front[0] * found.strict)


def _merging(
    count: Int[Array, " cells"], quantities: list[tuple[Array, Array]], tables: tuple[RangeTables, ...]
) -> tuple[Float[Array, " cells"], Float[Array, " cells"]]:
    """By how much colour and extinction of a sample can be rounded otherwise when cells of so many particles are merged.

    A look-up changes by no more than its channel has, even at a jump, and by nothing where all `quantities` are one.
    """
    rounding, found = sum_rounding(count, tables[0].scale.dtype), []
    for part, (least, greatest) in zip(tables, quantities, strict=True):
        misplaced = rounding * (greatest - least)
        found.append(jnp.where(misplaced > 0, jnp.minimum(part.steepest[:, None] * misplaced, part.scale[:, None]), 0))
    return found[0][:3].max(0), found[-1][3]


def _extremes(value: Array, where: Array, axis: int = 0) -> tuple[Array, Array]:
    """Least and greatest of those that count."""
    return jnp.where(where, value, jnp.inf).min(axis), jnp.where(where, value, -jnp.inf).max(axis)
