"""Cubics are met between nodes, and between the rays of subsampled slabs."""

from __future__ import annotations

import itertools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY

from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.field.interpolation import between_subsamples, interpolate
from jaxsph.engine.field.lattice import FINEST, GAP, REACH, Lattice, Region, Spacing
from jaxsph.engine.field.schedule import MAX_SPACING_LEVEL, SUBSAMPLE


def test_cubics_are_met_and_so_are_the_rays_themselves():
    rays, weights = np.arange(BUNDLE), between_subsamples()
    for power in range(4):
        np.testing.assert_allclose(weights @ np.float64(SUBSAMPLE) ** power, rays.astype(float) ** power, atol=1e-12)
    np.testing.assert_array_equal(weights[list(SUBSAMPLE)], np.eye(len(SUBSAMPLE)))


@pytest.mark.parametrize("spacing", [FINEST, Spacing(8, 4)])
def test_a_cubic_field_is_interpolated_exactly(spacing, x64):
    rng, slab_samples = np.random.default_rng(0), 2 * spacing.samples
    z, y, x = np.meshgrid(np.arange(16.0), np.arange(9.0), np.arange(8.0), indexing="ij")
    cubic = rng.normal(size=(4, 4, 4))
    field = np.pad(np.polynomial.polynomial.polyval3d(z / 12, y / 9, x / 8, cubic), ((REACH, GAP), (0, GAP), (0, GAP)))
    region = Region(np.int32(0), np.int32(0), 4, 4, spacing)
    lattice = Lattice(field, (2 * field,), np.float64(0), region, np.zeros(1))
    slab, row, column = where = np.array([1, 2]), np.array([2, 4]), np.array([4, 2])

    def at_every_level(lattice, slab, row, column):
        each = range(MAX_SPACING_LEVEL + 1)
        return [interpolate(lattice, slab, (row, column), slab_samples=slab_samples, level=level) for level in each]

    every = jax.tree.map(np.asarray, jax.jit(at_every_level, compiler_options=QUICKLY)(lattice, *where))
    for (level, found), k in itertools.product(enumerate(every), range(2)):
        middles = (np.arange(slab_samples) + 0.5) * 2**level - 0.5
        at = [
            middles / spacing.samples + 2 * slab[k],
            np.arange(8) / spacing.pixels + row[k],
            np.arange(8) / spacing.pixels + column[k],
        ]
        zs, ys, xs = np.meshgrid(*at, indexing="ij")
        wanted = np.polynomial.polynomial.polyval3d(zs / 12, ys / 9, xs / 8, cubic).reshape(slab_samples, 64)
        np.testing.assert_allclose(found.all[0][k], wanted, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(found.all[1][k], 2 * wanted, rtol=1e-10, atol=1e-10)
