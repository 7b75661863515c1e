"""Windows of slabs, drawn at random, and which samples lie in which supports: what grids are held against."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxsph.engine.access.grid import CELL_SAMPLES, SlabWindows

CLASSES, CELLS, BUNDLES = 2, 17, 3


def windows_of(slab_samples):
    """Windows of slabs that begin one after the other, some of them empty."""
    rng = np.random.default_rng(slab_samples)
    shape = (CLASSES, CELLS * CELL_SAMPLES // slab_samples, BUNDLES)
    begin = np.sort(rng.integers(0, 900, shape), 1).astype(np.int32)
    length = np.where(rng.uniform(size=shape) < 0.3, 0, rng.integers(1, 40, shape)).astype(np.int32)
    return SlabWindows(begin, length, length.sum(0, dtype=np.int32))


@functools.partial(jax.jit, static_argnames="samples")
def rays(camera, rows, columns, samples):
    """Depths of samples, and lateral coordinates of rays through the middles of pixels."""
    depth = camera.depth(jnp.arange(samples, dtype=rows.dtype) + 0.5, samples).astype(rows.dtype)
    return depth, camera.column(columns + 0.5), camera.row(rows + 0.5)


def margins(ordered, camera, rows, columns, samples):
    """Of particles at samples, in the arithmetic of the march, > 0 within supports: (rows, columns, samples, particles)."""
    dtype = np.asarray(ordered.x).dtype
    s, u, v = map(np.asarray, rays(camera, np.asarray(rows, dtype), np.asarray(columns, dtype), samples))
    s = s[:, None]
    spread = s if camera.is_perspective else np.ones_like(s)
    x, y, z, scale, size = (np.asarray(getattr(ordered, name)) for name in ("x", "y", "z", "scale", "size"))
    across, down = ((spread * u[:, None, None] - x) * scale) ** 2, ((spread * v[:, None, None] - y) * scale) ** 2
    return size**2 - ((s - z) * scale) ** 2 - down[:, None] - across[None]
