"""Slabs marched at some rays: those are the sums of full rate, and cubics are met between them."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.access.lists import BUNDLE
from jaxsph.cast.march import evaluations, gather
from jaxsph.field.subsampled import cubics, gather_subsampled
from jaxsph.cast.batches import batches_of
from jaxsph.field.schedule import SUBSAMPLE, full_rate


def test_cubics_are_met_and_so_are_the_rays_themselves():
    rays = np.arange(BUNDLE)
    for power in range(4):
        np.testing.assert_allclose(cubics() @ np.float64(SUBSAMPLE) ** power, rays.astype(float) ** power, atol=1e-12)
    np.testing.assert_array_equal(cubics()[list(SUBSAMPLE)], np.eye(len(SUBSAMPLE)))


EYE, TARGET, SIZE = (1.5, 1.1, -2.2), (0.5, 0.5, 0.5), {"width": 230, "height": 197}
CAMERAS = {
    "perspective": lambda: js.Camera.look_at(EYE, TARGET, near=1.0, far=5.0, **SIZE),
    "orthographic": lambda: js.Camera.orthographic(EYE, TARGET, near=1.0, far=5.0, **SIZE),
}


@pytest.mark.parametrize("kind", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_sums_are_those_of_all_rays_where_rays_are_taken_and_near_them_between(x64, stages, kind):
    rng, camera = np.random.default_rng(4), CAMERAS[kind]()
    position = rng.uniform(0, 1, (2000, 3))
    particles = js.Particles.from_arrays(position, 0.2, position[:, 0])
    transfer = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 1], [1, 0, 0]], [1.0, 1.0])
    plan = js.plan(js.Scene(particles=particles, transfer=transfer), camera, js.Settings(samples=96))
    grid, origin = stages(particles, camera, plan=plan)
    work = full_rate(grid.windows, origin)
    stretches = batches_of(grid, work, plan.cast)
    fullest = np.argsort(np.asarray(work.count).ravel())[-plan.cast.chunk :]
    item, slab, bundle = stretches.item(jnp.asarray(fullest, jnp.int32))
    u, v = (rays.T for rays in grid.rays(camera, bundle))
    rays = u, v, stretches.depths(item, slab)[0]
    settings = {"perspective": camera.is_perspective, "kernel": particles.kernel}
    every = np.asarray(jax.jit(functools.partial(gather, **settings))(grid.ordered, grid.lists.rank, item, rays))
    few = np.asarray(jax.jit(functools.partial(gather_subsampled, **settings))(grid, item, rays))
    at = np.ix_(range(len(few)), range(few.shape[1]), SUBSAMPLE, SUBSAMPLE)
    np.testing.assert_allclose(few[at], every[at], rtol=1e-12, atol=1e-12 * np.abs(every).max())
    assert np.sqrt((np.abs(few - every) ** 2).mean()) < 0.02 * np.sqrt((np.abs(every) ** 2).mean())
    assert np.abs(few - every).max() > 0


def test_a_sparse_slab_takes_a_quarter_of_the_evaluations(stages):
    scene, camera = js.scenes.load("mixer", 500, width=40, height=33)
    plan = js.plan(scene, camera, js.Settings(samples=96))
    grid, origin = stages(scene.particles, camera, plan=plan)
    work = full_rate(grid.windows, origin)
    all_rays = evaluations(work, plan.samples, plan.cast)
    some = evaluations(dataclasses.replace(work, sparse=work.filled), plan.samples, plan.cast)
    np.testing.assert_allclose(some, 0.25 * np.asarray(all_rays))
    assert float(all_rays.sum()) > 0
