"""Rays at which slabs are subsampled have the sums of full rate; between them and between nodes cubics are met."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.cast.batches import batches_of
from jaxsph.engine.field.gather import gather
from jaxsph.engine.field.lattice import (
    GAP,
    REACH,
    Lattice,
    Region,
    between_subsamples,
    gather_subsampled,
    interpolate,
    sum_at_nodes,
)
from jaxsph.engine.field.tasks import FINEST, MAX_SPACING_LEVEL, SUBSAMPLE, RayPackets, Spacing, full_rate


@pytest.mark.parametrize("samples", [3, 16, 40])
@pytest.mark.parametrize("slab_samples", [4, 16])
def test_the_widest_stencil_of_the_last_slab_lies_in_the_lattice(frames, stages, slab_samples, samples):
    """Where all are read at once, for accelerators, a shorter lattice would have them moved."""
    few, rng = dataclasses.replace(frames, samples=samples), np.random.default_rng(0)
    plan, region = few.plan(slab_samples), Region(jnp.int32(0), jnp.int32(0), 4, 4, FINEST)

    camera = few.camera(rng)
    grid, _ = stages.eval_shape(few.scene(rng).particles, camera, plan=plan)

    def lattice(grid, camera):
        return sum_at_nodes(grid, camera, "poly6", slab_samples, region, (jnp.float32(0.4),), 16)

    layers = jax.eval_shape(lattice, grid, camera).weight.shape[0]
    within, last = slab_samples // FINEST.samples, -(-samples // slab_samples) - 1
    assert REACH + last * within - 1 + (within << MAX_SPACING_LEVEL) + 3 <= layers


@functools.partial(jax.jit, static_argnames=("plan", "kernel"), compiler_options=QUICKLY)
def sums_of(grid, reference, camera, slabs, *, plan, kernel):
    """Sums at all rays of some slabs, and of those that are subsampled."""
    packets = RayPackets(*grid.rays(camera, jnp.arange(plan.lists.num_bundles)))
    batches = batches_of(grid, full_rate(grid.windows, reference), packets, plan.cast, camera.is_perspective)
    task = batches.task(slabs)
    return [how(grid.ordered, grid.lists.rank, task, kernel=kernel) for how in (gather, gather_subsampled)]


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
    fullest = np.argsort(np.asarray(grid.windows.count).ravel())[-plan.cast.chunk :].astype(np.int32)
    every, few = (
        np.asarray(sums.all[0]) + 1j * np.asarray(sums.all[1])
        for sums in sums_of(grid, reference, camera, fullest, plan=plan, kernel=particles.kernel)
    )
    at = np.ix_(range(len(few)), range(few.shape[1]), SUBSAMPLE, SUBSAMPLE)
    np.testing.assert_allclose(few[at], every[at], rtol=1e-12, atol=1e-12 * np.abs(every).max())
    assert np.sqrt((np.abs(few - every) ** 2).mean()) < 0.02 * np.sqrt((np.abs(every) ** 2).mean())
    assert np.abs(few - every).max() > 0


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
