r"""Where the error analysis can pay: a cheap look at a few particles of every cell.

Flow: cells -> [probe] -> analysis -> levels -> merge -> cast -> image.

Bounds need every particle of a cell, and most cells of a mixed fluid then turn out to vary too much. A few particles from the
middle of a slab's window vary less than all of them, so where even their quantities would change the image by more than the
tolerance, nothing is lost by leaving the cell at full rate without looking further. The probe decides nothing else: whatever
it says, what is analysed is bounded with care.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.engine.access.compaction import compact
from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.slab_windows import CELL_SAMPLES
from jaxsph.engine.control.ranges import RangeTables, ranges_of_parts
from jaxsph.engine.field.fetch import position
from jaxsph.numerics.fusion import fusion_barrier

PROBES = 8  # particles of each slab, from the middle half of its window
MIN_PROMISING_SHARE = 0.1  # of a band's work, that promising cells must hold: the analysis costs up to a third of their cast


def probe(
    grid: Grid,
    tables: tuple[RangeTables, ...],
    tolerance: Float[Array, ""],
    slab_samples: int,
    cells_at_once: int,
) -> Bool[Array, "cells bundles"]:
    """Cells whose probes would change the image by less than `tolerance` under a super-pixel, and all of opaque bundles.

    Bundles that the probes find opaque are analysed whole, as only bounds can tell how much of what lies behind is hidden.
    What is promising grows with `tolerance`. Where such cells hold too little of the work to be analysed, there are none.

    Args:
        tables: of the parts of the transfer function.
    """
    quantities, rank, cells = grid.ordered.quantities, grid.lists.rank, grid.windows
    slabs, bundles = cells.count.shape
    per_cell = CELL_SAMPLES // slab_samples
    num_cells = -(-slabs // per_cell)
    chunk = min(cells_at_once, -(-bundles // 16) * 16)
    pad = ((0, 0), (0, num_cells * per_cell - slabs + per_cell), (0, 0))
    begin, length = (jnp.pad(window, pad) for window in (cells.begin, cells.length))
    count = length.sum(0).reshape(num_cells + 1, per_cell, bundles)[:-1].sum(1)
    compacted = compact(count > 0)
    items = jnp.pad(compacted.item, (0, chunk), constant_values=num_cells * bundles)
    borders = grid.borders(num_cells * CELL_SAMPLES)
    steps = borders[slab_samples::slab_samples] - borders[:-slab_samples:slab_samples]

    def probe_chunk(step: Array, table: Array) -> Array:
        at = lax.dynamic_slice(items, (step * chunk,), (chunk,))
        cell, bundle = at // bundles, at % bundles
        slab = cell * per_cell + jnp.arange(per_cell, dtype=jnp.int32)[:, None]
        window = begin[:, slab, bundle], length[:, slab, bundle]
        ends = [fusion_barrier(step >= 0, _extremes, quantity, rank, window) for quantity in quantities]
        entry = fusion_barrier(step >= 0, _varies, ends, steps[slab], tables)
        return table.at[:, at].set(entry)

    table = jnp.zeros((2, num_cells * bundles + 1), quantities[0].dtype)
    table = lax.fori_loop(0, (compacted.start[-1] + chunk - 1) // chunk, probe_chunk, table)
    change, depth = table[:, :-1].reshape(2, num_cells, bundles)
    behind = jnp.exp(-lax.associative_scan(jnp.add, depth))
    front = jnp.concatenate([jnp.ones_like(behind[:1]), behind[:-1]])
    found = (count > 0) & ((front * change <= tolerance) | (behind[-1] < tolerance))
    held, all_held = (jnp.where(where, count, 0).astype(jnp.float32).sum() for where in (found, True))
    return found & (held >= MIN_PROMISING_SHARE * all_held)


def _extremes(quantity: Array, rank: Array, window: tuple[Array, Array]) -> tuple[Array, Array]:
    """Least and greatest quantity of the probes of slabs; of none, infinite and negative infinite."""
    total = window[1].sum(0)
    lo, hi = jnp.full(total.shape, jnp.inf, quantity.dtype), jnp.full(total.shape, -jnp.inf, quantity.dtype)
    for k in range(PROBES):
        index = (total * (2 * k + 1 + PROBES)) // (4 * PROBES)
        value = quantity[rank[jnp.clip(position(index, *window), 0, rank.shape[0] - 1)]]
        lo, hi = jnp.minimum(lo, value), jnp.maximum(hi, value)
    return jnp.where(total > 0, lo, jnp.inf), jnp.where(total > 0, hi, -jnp.inf)


def _varies(ends: list[tuple[Array, Array]], steps: Array, tables: tuple[RangeTables, ...]) -> Array:
    """How much cells could change under a super-pixel, and their least optical thickness, as far as probes can tell."""
    filled = ends[0][1] >= ends[0][0]
    least, greatest = ranges_of_parts(tables, [(jnp.where(filled, lo, 0), jnp.where(filled, hi, 0)) for lo, hi in ends])
    thin, thick = least[3] * steps, greatest[3] * steps
    off = jnp.stack([high - low for low, high in zip(least[:3], greatest[:3], strict=True)]).max(0)
    middle = 0.5 * (thin + thick)
    change = jnp.exp(-middle) * -jnp.expm1(-0.5 * (thick - thin)) - 0.5 * off * jnp.expm1(-middle)
    return jnp.stack([jnp.where(filled, change, 0).sum(0), jnp.where(filled, thin, 0).sum(0)])
