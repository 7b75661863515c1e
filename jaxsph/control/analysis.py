"""The error analysis of a band: what every cell's candidates would cost in light, front to back.

Flow: cells -> [analysis: bounds -> errors] -> levels -> merge -> cast -> image.

Filled cells are stacked and marched layer by layer, as the cast does, so that empty space costs nothing.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.access.cells import Cells
from jaxsph.access.lists import BUNDLE, BundleLists
from jaxsph.access.ordering import Ordered
from jaxsph.access.stacks import stack
from jaxsph.control.bounds import Footprint, sample_bounds, spheres
from jaxsph.control.errors import CANDIDATES, CELL, cell_errors
from jaxsph.control.ranges import range_tables
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics.staging import computed_once

CHUNK = 512  # bundles analysed together: operands of their cells stay in the second-level cache


@dataclasses.dataclass(frozen=True)
class Analysis:
    """Errors of all candidates of all cells: levels 0 to 4, super-pixel. Empty cells have none.

    Attributes:
        error: bound (an estimate if relaxed) of the change of the bundle's pixels.
        strict: the same, never relaxed.
        paint: red, green, blue and extinction of each cell's super-pixel.
    """

    error: Float[Array, "candidates cells bundles"]
    strict: Float[Array, "candidates cells bundles"]
    paint: Float[Array, "4 cells bundles"]


def analyse(
    ordered: Ordered,
    lists: BundleLists,
    cells: Cells,
    origins: tuple[Int[Array, " bundles"], Int[Array, " bundles"]],
    camera: Camera,
    transfer: TransferFunction,
    half_steps: Float[Array, " two_samples_and_one"],
    relax: Float[Array, ""],
    slab_samples: int,
) -> Analysis:
    """Analyse all filled cells of a band; the arguments are those of `cast_points`.

    Args:
        relax: share of the lateral variation that is taken off the estimate, 0 for a certificate.
        slab_samples: samples of each slab of `cells`.
    """
    slabs, bundles = cells.count.shape
    dtype = ordered.x.dtype
    per_cell = CELL // slab_samples
    num_cells = -(-slabs // per_cell)
    chunk = min(CHUNK, -(-bundles // 16) * 16)
    tables, balls = range_tables(transfer), spheres(ordered)
    missing = num_cells * per_cell - slabs
    count = jnp.pad(cells.count, ((0, missing), (0, 0))).reshape(num_cells, per_cell, bundles).sum(1)
    stacks = stack(count > 0, count, 1, chunk)
    row, column = (jnp.append(origin, 0) for origin in origins)
    begin, length = (jnp.pad(window, ((0, 0), (0, missing + per_cell), (0, 1))) for window in (cells.begin, cells.length))
    borders = jnp.pad(half_steps[::2], (0, (num_cells + 1) * CELL - half_steps.shape[0] // 2), mode="edge")

    pixel = jnp.arange(BUNDLE, dtype=jnp.int32)[:, None]

    def analyse_layer(layer: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        def analyse_chunk(step: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            front, table = state
            bundle = lax.dynamic_slice(stacks.order, (layer, step * chunk), (1, chunk))[0]
            cell = stacks.place[layer, bundle]
            u = camera.column((column[bundle] + pixel).astype(dtype) + 0.5)
            v = camera.row((row[bundle] + pixel).astype(dtype) + 0.5)
            slab = (cell * per_cell + jnp.arange(per_cell, dtype=jnp.int32)[:, None]).reshape(-1)
            window = tuple(side[:, slab, jnp.tile(bundle, per_cell)] for side in (begin, length))
            edges = borders[slab * slab_samples + jnp.arange(slab_samples + 1, dtype=jnp.int32)[:, None]]
            footprint = Footprint(jnp.tile(u, per_cell), jnp.tile(v[::-1], per_cell))
            of_slabs = sample_bounds(balls, lists.rank, window, footprint, edges, tables, camera.is_perspective)
            bounds = jax.tree.map(functools.partial(_by_cell, per_cell=per_cell), of_slabs)
            edges = borders[cell * CELL + jnp.arange(CELL + 1, dtype=jnp.int32)[:, None]]
            paths = jnp.ones((BUNDLE, BUNDLE, chunk), dtype)
            if camera.is_perspective:
                paths = jnp.sqrt(1 + u[:, None] ** 2 + v**2)
            path = paths.min((0, 1)), paths.max((0, 1))
            found = computed_once(step >= 0, cell_errors, bounds, edges, *path, front[bundle], relax)
            entry = jnp.concatenate([found.error, found.strict, found.paint])
            return front.at[bundle].set(found.front), table.at[:, cell, bundle].set(entry)

        return lax.fori_loop(0, stacks.num_chunks[layer], analyse_chunk, state)

    state = jnp.ones(bundles + 1, dtype), jnp.zeros((2 * CANDIDATES + 4, num_cells + 1, bundles + 1), dtype)
    _, table = lax.fori_loop(0, (stacks.num_chunks > 0).sum(), analyse_layer, state)
    return Analysis(*jnp.split(table[:, :-1, :-1], [CANDIDATES, 2 * CANDIDATES]))


def _by_cell(value: Array, per_cell: int) -> Array:
    """(samples of a slab, slabs of cells) to (samples of a cell, cells)."""
    samples = value.shape[0]
    return jnp.moveaxis(value.reshape(samples, per_cell, -1), 1, 0).reshape(per_cell * samples, -1)


jax.tree_util.register_dataclass(Analysis, data_fields=["error", "strict", "paint"], meta_fields=[])
