"""Cubics are met between nodes and between the rays of subsampled slabs, and those rays have the sums of full rate."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.access.lists import BUNDLE
from jaxsph.cast.batches import batches_of
from jaxsph.field.gather import gather
from jaxsph.field.interpolation import between_subsamples, gather_subsampled, interpolate
from jaxsph.field.lattice import FINEST, GAP, REACH, Lattice, Region, Spacing
from jaxsph.field.schedule import MAX_SPACING_LEVEL, SUBSAMPLE, full_rate
from jaxsph.field.tasks import RayPackets


def test_cubics_are_met_and_so_are_the_rays_themselves():
    rays, weights = np.arange(BUNDLE), between_subsamples()
    for power in range(4):
        np.testing.assert_allclose(weights @ np.float64(SUBSAMPLE) ** power, rays.astype(float) ** power, atol=1e-12)
    np.testing.assert_array_equal(weights[list(SUBSAMPLE)], np.eye(len(SUBSAMPLE)))


EYE, TARGET, SIZE = (1.5, 1.1, -2.2), (0.5, 0.5, 0.5), {"width": 230, "height": 197}
CAMERAS = {
    "perspective": lambda: js.Camera.look_at(EYE, TARGET, near=1.0, far=5.0, **SIZE),
    "orthographic": lambda: js.Camera.orthographic(EYE, TARGET, near=1.0, far=5.0, **SIZE),
}


@pytest.mark.parametrize("projection", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_sums_are_those_of_all_rays_where_rays_are_taken_and_near_them_between(x64, stages, projection):
    rng, camera = np.random.default_rng(4), CAMERAS[projection]()
    position = rng.uniform(0, 1, (2000, 3))
    particles = js.Particles.from_arrays(position, 0.2, position[:, 0])
    transfer = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 1], [1, 0, 0]], [1.0, 1.0])
    plan = js.plan(js.Scene(particles=particles, transfer=transfer), camera, js.Settings(samples=96))
    grid, reference = stages(particles, camera, plan=plan)
    schedule = full_rate(grid.windows, reference)
    packets = RayPackets(*grid.rays(camera, jnp.arange(plan.lists.num_bundles)))
    batches = batches_of(grid, schedule, packets, plan.cast, camera.is_perspective)
    fullest = np.argsort(np.asarray(schedule.count).ravel())[-plan.cast.chunk :]
    task = batches.task(jnp.asarray(fullest, jnp.int32))

    def sums_by(how):
        sums = jax.jit(functools.partial(how, kernel=particles.kernel))(grid.ordered, grid.lists.rank, task)
        return np.asarray(sums.weight) + 1j * np.asarray(*sums.weighted)

    every, few = sums_by(gather), sums_by(gather_subsampled)
    at = np.ix_(range(len(few)), range(few.shape[1]), SUBSAMPLE, SUBSAMPLE)
    np.testing.assert_allclose(few[at], every[at], rtol=1e-12, atol=1e-12 * np.abs(every).max())
    assert np.sqrt((np.abs(few - every) ** 2).mean()) < 0.02 * np.sqrt((np.abs(every) ** 2).mean())
    assert np.abs(few - every).max() > 0


@pytest.mark.parametrize("spacing", [FINEST, Spacing(8, 4)])
@pytest.mark.parametrize("level", range(MAX_SPACING_LEVEL + 1))
def test_a_cubic_field_is_interpolated_exactly(level, spacing, x64):
    rng, slab_samples = np.random.default_rng(0), 2 * spacing.samples
    z, y, x = np.meshgrid(np.arange(16.0), np.arange(9.0), np.arange(8.0), indexing="ij")
    cubic = rng.normal(size=(4, 4, 4))
    field = jnp.asarray(np.polynomial.polynomial.polyval3d(z / 12, y / 9, x / 8, cubic))
    field = jnp.pad(field, ((REACH, GAP), (0, GAP), (0, GAP)))
    region = Region(jnp.int32(0), jnp.int32(0), 4, 4, spacing)
    lattice = Lattice(field, (2 * field,), jnp.float64(0), region, jnp.zeros(1))
    slab, row, column = jnp.asarray([1, 2]), jnp.asarray([2, 4]), jnp.asarray([4, 2])
    found = jax.jit(interpolate, static_argnames=("slab_samples", "level"))(
        lattice, slab, (row, column), slab_samples=slab_samples, level=level
    )
    middles = (np.arange(slab_samples) + 0.5) * 2**level - 0.5
    for k in range(2):
        at = [
            middles / spacing.samples + 2 * float(slab[k]),
            np.arange(8) / spacing.pixels + float(row[k]),
            np.arange(8) / spacing.pixels + float(column[k]),
        ]
        zs, ys, xs = np.meshgrid(*at, indexing="ij")
        wanted = np.polynomial.polynomial.polyval3d(zs / 12, ys / 9, xs / 8, cubic).reshape(slab_samples, 64)
        np.testing.assert_allclose(found.weight[k], wanted, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(found.weighted[0][k], 2 * wanted, rtol=1e-10, atol=1e-10)
