"""Sums between rays and samples where they are known: by cubics, from the nodes of a lattice or from a few rays of a bundle.

Flow: lattice, gather -> [interpolation] -> methods.

Sums over particles are smoother than what the transfer function makes of their ratio. Where a lattice does not tell enough, the
rays of `SUBSAMPLE` often do, at a quarter of the evaluations: they are up to three pixels apart, and every sample along them is
taken. No ray outside the bundle is needed, for which its lists would lack particles.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.field.lattice import REACH, Lattice, Spacing
from jaxsph.engine.field.schedule import MAX_SPACING_LEVEL, SUBSAMPLE
from jaxsph.engine.field.sums import Sums, sums_of
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.numerics.fusion import barriers_kept


def interpolate(
    lattice: Lattice, slab: Int[Array, " tasks"], corner: tuple[Array, Array], slab_samples: int, level: Int[Array, ""] | int = 0
) -> Sums:
    """Sums (tasks, samples, 64) at all samples of slabs, by the tensor product of cubics through the nearest four nodes.

    Args:
        slab: slabs that lie inside the lattice, with a node to spare on every side.
        corner: first node of their bundles, down and across.
        slab_samples: samples of a slab.
        level: samples are `2**level` fine samples apart, up to `MAX_SPACING_LEVEL`.
    """
    spacing = lattice.region.spacing
    within = slab_samples // spacing.samples
    first = jnp.stack([REACH + slab * within - 1, corner[0] - 1, corner[1] - 1], -1)
    layers = [(within << k) + 3 for k in range(MAX_SPACING_LEVEL + 1)]
    near = [functools.partial(_near, lattice, first, layers=number, room=layers[-1]) for number in layers]
    # at hand before anything is made of it: each of the nodes would be fetched for every sample that it is a part of
    nodes = lax.switch(level, near) if barriers_kept() else near[-1]()
    across = between_nodes(spacing.across, spacing.pixels)
    lateral = jnp.asarray(np.kron(across, across).T, lattice.weight.dtype)
    in_depth = jnp.stack([_in_depth(channel, level, spacing, slab_samples) for channel in nodes.all])
    return sums_of(list(jnp.matmul(in_depth, lateral, precision=lax.Precision.HIGHEST)))


def interpolate_slabs(lattice: Lattice, grid: Grid, task: SlabTask) -> Sums:
    """Sums (tasks, samples, 8, 8) of slabs of the same level, of which the first is no dummy."""
    row, column = (side[task.bundle] * lattice.region.spacing.across for side in lattice.region.place(grid)[:2])
    found = interpolate(lattice, task.slab, (row, column), task.depth.shape[1], task.entry.level[0])
    shape = (*found.packed[0].shape[:2], BUNDLE, BUNDLE)
    return dataclasses.replace(found, packed=tuple(value.reshape(shape) for value in found.packed))


def _near(lattice: Lattice, first: Int[Array, "tasks 3"], *, layers: int, room: int) -> Sums:
    """Sums at the nodes around slabs (tasks, room, nodes), those of a layer in a row, of the `layers` from the `first` on."""
    around = lax.GatherDimensionNumbers(offset_dims=(1, 2, 3), collapsed_slice_dims=(), start_index_map=(0, 1, 2))
    across = lattice.region.spacing.across + 3
    size = layers, across, across
    found = (lax.gather(sums, first, around, size, mode="clip") for sums in (lattice.weight, *lattice.weighted))
    return sums_of([jnp.pad(one.reshape(-1, layers, across**2), ((0, 0), (0, room - layers), (0, 0))) for one in found])


def _in_depth(
    nodes: Float[Array, "tasks layers nodes"], level: Int[Array, ""] | int, spacing: Spacing, samples: int
) -> Float[Array, "tasks samples nodes"]:
    """Layers in the middle of every `2**level` fine samples."""
    steps = 1 << np.arange(MAX_SPACING_LEVEL + 1)[:, None]
    # nodes sit on fine samples, whose middles are where they are: so a window of `step` has its own half a sample before its end
    past = ((np.arange(samples) + 0.5) * steps - 0.5) / spacing.samples
    layer = past.astype(np.int32)
    taps = jnp.asarray(cubic(past - layer), nodes.dtype)[:, level, :, None]
    near = (nodes.at[:, jnp.asarray(layer)[level] + k].get(mode="promise_in_bounds") for k in range(4))
    return functools.reduce(jnp.add, (tap * at for tap, at in zip(taps, near, strict=True)))


def between_nodes(cells: int, every: int) -> Float[np.ndarray, "points nodes"]:
    """Weights of the cubic through the nearest four nodes, for points that divide `cells` cells by `every`.

    Nodes begin one before the first cell and end one after the last.
    """
    table = np.zeros((cells * every, cells + 3))
    for point in range(cells * every):
        cell = point // every
        table[point, cell : cell + 4] = cubic(point % every / every)
    return table


def cubic(t: Any) -> tuple[Any, Any, Any, Any]:
    """Weights of nodes at -1, 0, 1 and 2 for the cubic through them at `t`."""
    return -t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6


def spread_subsamples(sums: Float[Array, "channels samples 4 4 tasks"]) -> Float[Array, "channels tasks samples 8 8"]:
    """Sums at every ray of a bundle, by the tensor product of cubics through its `SUBSAMPLE` rays, given those at these."""
    by_slab = jnp.moveaxis(sums.reshape(*sums.shape[:2], -1, sums.shape[-1]), 3, 1)  # while they are few
    lateral = jnp.asarray(np.kron(between_subsamples(), between_subsamples()).T, by_slab.dtype)
    spread = jnp.matmul(by_slab, lateral, precision=lax.Precision.HIGHEST)
    return spread.reshape(*spread.shape[:3], BUNDLE, BUNDLE)


def between_subsamples() -> Float[np.ndarray, "8 4"]:
    """Weights of `SUBSAMPLE` rays for each ray along a side of a bundle: the cubic through them, which meets them exactly."""
    near = np.asarray(SUBSAMPLE, float)
    weights = np.ones((BUNDLE, near.size))
    for k, here in enumerate(near):
        for other in np.delete(near, k):
            weights[:, k] *= (np.arange(BUNDLE) - other) / (here - other)
    return weights
