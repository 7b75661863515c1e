"""Turn choices into a schedule: coarse slabs with the particles that they need, cells merged until they are full.

Flow: levels -> [merge] -> schedule -> cast -> image.

A slab of S samples at level l spans 2^l slabs of fine samples, and its particles are the union of their windows: windows of
one depth-ordered list, so nothing is copied and nothing is referenced twice (Hochstetter et al. 2016, section 6.2). As long as
it fits into a cell, a cell gets fewer slabs; beyond that, neighbouring cells are merged in pairs, level by level, if all of
them allow it. A cell whose neighbours do not falls back to the last level that fits, which costs the same and errs less.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.slab_windows import CELL_SAMPLES, MAX_LEVEL, Window
from jaxsph.engine.control.errors import LEVELS, SUPER_PIXEL, fits
from jaxsph.engine.field.schedule import SlabSchedule


def evaluations_of_levels(windows: list[Window], num_cells: int, slab_samples: int, merge: bool) -> list[Array | None]:
    """Kernel evaluations a ray and cell at every level, (cells, bundles); None where a level does not fit without merging."""
    costs: list[Array | None] = []
    fitting = fits(slab_samples)
    for level, window in enumerate(windows):
        count = window.length.sum(0).astype(jnp.float32) * slab_samples
        if level <= fitting:
            groups = CELL_SAMPLES // slab_samples >> level
            costs.append(count.reshape(-1, groups, count.shape[1]).sum(1)[:num_cells])
        else:
            share = 1 << (level - fitting)
            costs.append(jnp.repeat(count / share, share, 0)[:num_cells] if merge else None)
    return costs


def merged_levels(
    chosen: Int[Array, "cells bundles"], free: Bool[Array, "cells bundles"], slab_samples: int
) -> Int[Array, "cells bundles"]:
    """Levels that neighbours agree on: above what fits into a cell, the highest that all of an aligned group allow.

    Args:
        chosen: candidate of every cell.
        free: cells that no particle can touch, nor their borders: they allow any level.
        slab_samples: samples of a slab.
    """
    fitting, num_cells = fits(slab_samples), chosen.shape[0]
    lateral = chosen == SUPER_PIXEL
    final = jnp.where(lateral, SUPER_PIXEL, jnp.minimum(chosen, fitting))
    able = jnp.where(free, MAX_LEVEL, jnp.where(lateral, 0, chosen))
    for level in range(fitting + 1, LEVELS):
        share = 1 << (level - fitting)
        groups = jnp.pad(able, ((0, -num_cells % share), (0, 0))).reshape(-1, share, able.shape[1])
        final = jnp.where(jnp.repeat((groups >= level).all(1), share, 0)[:num_cells], level, final)
    return final


def coarse_schedule(
    windows: list[Window],
    levels: Int[Array, "cells bundles"],
    references: tuple[Float[Array, "slabs bundles"], ...],
    paint: Array | None,
    slab_samples: int,
) -> SlabSchedule:
    """The schedule for the `levels` of cells, as `merged_levels` gives them.

    Args:
        references: of the slabs at full rate; coarser ones take those of the first filled slab they span.
        paint: colours and extinction of super-pixels, (4, cells, bundles); None where there are none.
    """
    per_cell = CELL_SAMPLES // slab_samples
    classes, slabs, bundles = windows[0].begin.shape
    missing = slabs - levels.shape[0] * per_cell
    level = jnp.pad(jnp.repeat(levels, per_cell, 0), ((0, missing), (0, 0)))
    place = jnp.arange(slabs, dtype=jnp.int32)[:, None]
    painted = (level == SUPER_PIXEL) & (place % per_cell == 0)
    begin = length = jnp.zeros((classes, slabs, bundles), jnp.int32)
    for step, window in enumerate(windows):
        here = (level == step) & (place % (1 << step) == 0)
        begin = jnp.where(here, jnp.repeat(window.begin, 1 << step, 1), begin)
        length = jnp.where(here, jnp.repeat(window.length, 1 << step, 1), length)
    count = length.sum(0).astype(jnp.int32)
    references = tuple(_shared_references(reference, windows, level) for reference in references)
    level = jnp.where(level == SUPER_PIXEL, MAX_LEVEL, level)
    if paint is None:
        return SlabSchedule(count > 0, level, begin, length, count, references)
    colors = jnp.pad(jnp.repeat(paint, per_cell, 1), ((0, 0), (0, missing), (0, 0)))
    return SlabSchedule((count > 0) | painted, level, begin, length, count, references, painted, colors)


def _shared_references(reference: Array, windows: list[Window], level: Array) -> Array:
    """Of every item, that of the first filled slab that it spans."""
    first = shared = jnp.pad(reference, ((0, level.shape[0] - reference.shape[0]), (0, 0)))
    for step in range(1, LEVELS):
        filled = windows[step - 1].length.sum(0) > 0
        first = jnp.where(filled[::2], first[::2], first[1::2])
        shared = jnp.where(level == step, jnp.repeat(first, 1 << step, 0), shared)
    return shared
