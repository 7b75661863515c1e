"""Slabs that are marched at a few of their rays, between which sums are interpolated.

Flow: worklist -> [sparse] -> points -> image.

Sums over particles are smoother than what the transfer function makes of their ratio. Where nodes as far apart as those of the
lattice do not tell enough, the rays of `SPARSE` often do, at a quarter of the evaluations: they are up to three pixels apart,
and every sample along them is taken. No ray outside the bundle is needed, for which its lists would lack particles.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from jaxsph.access.grid import Grid
from jaxsph.access.lists import BUNDLE
from jaxsph.cast.nodes import sums_at
from jaxsph.control.worklist import SPARSE, Worklist
from jaxsph.numerics.staging import computed_once


def gather_sparse(
    grid: Grid, item: Worklist, rays: tuple[Array, Array, Array], perspective: bool, kernel: str
) -> Complex[Array, "chunk samples 8 8"]:
    """What `points.gather_field` sums up at every ray, by the tensor product of cubics through `SPARSE` rays."""
    u, v, s = (value.T for value in rays)
    few = np.asarray(SPARSE)
    sums = sums_at(grid, (item.begin, item.length), (u[few], v[few], s), item.origin, perspective, kernel)
    by_slab = computed_once(item.count[0] >= 0, _slabs_first, sums)
    along = jnp.asarray(np.kron(cubics(), cubics()).T, sums.dtype)
    spread = jnp.matmul(by_slab, along, precision=lax.Precision.HIGHEST)
    return lax.complex(spread[0], spread[1]).reshape(*spread.shape[1:3], BUNDLE, BUNDLE)


def _slabs_first(sums: Array) -> Array:
    """Sums (2, chunk, samples, rays) of those with the slabs last: moved while they are few."""
    return jnp.moveaxis(sums.reshape(*sums.shape[:2], -1, sums.shape[-1]), 3, 1)


def cubics() -> Float[np.ndarray, "8 4"]:
    """Weights of `SPARSE` rays for each ray along a side of a bundle: the cubic through them, which meets them exactly."""
    near = np.asarray(SPARSE, float)
    weights = np.ones((BUNDLE, near.size))
    for k, here in enumerate(near):
        for other in np.delete(near, k):
            weights[:, k] *= (np.arange(BUNDLE) - other) / (here - other)
    return weights
