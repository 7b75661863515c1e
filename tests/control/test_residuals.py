"""Where nothing is known, nothing is interpolated; and what is judged, is judged by what lies around it."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.control.residuals import residuals
from jaxsph.stages import sum_part


@pytest.fixture(scope="module")
def band(stages):
    scene, camera = js.scenes.load("checker_board", 3000, width=150, height=130)
    plan = js.plan(scene, camera, js.Settings(samples=96, tolerance=0.05, estimator="pilot"))
    grid, _ = stages(scene.particles, camera, plan=plan)
    lattice = sum_part(grid, camera, scene.transfer, jnp.int32(0), parts=1, plan=plan, kernel=scene.particles.kernel)
    judge = jax.jit(functools.partial(residuals, slab_samples=plan.cast.slab_samples))
    return grid, lattice, lambda lattice: judge(grid, lattice, camera, scene.transfer)


def test_some_slabs_with_particles_can_be_interpolated(band):
    grid, lattice, judge = band
    found = judge(lattice)
    filled = np.asarray(grid.cells.count) > 0
    usable = np.isfinite(found.variance)
    assert (usable & filled).sum() > 0.1 * filled.sum()
    assert (np.asarray(found.variance)[usable] > 0).all() and (np.asarray(found.bend) >= 0).all()


def test_rougher_sums_are_judged_worse(band):
    _, lattice, judge = band
    rough = lattice.weighted * (1 + 0.1 * np.random.default_rng(0).normal(size=lattice.weighted.shape).astype(np.float32))
    smooth, found = judge(lattice).variance, judge(dataclasses.replace(lattice, weighted=rough)).variance
    both = np.isfinite(smooth) & np.isfinite(found) & (np.asarray(smooth) > 1e-9)
    assert both.any() and (np.asarray(found)[both] > np.asarray(smooth)[both]).mean() > 0.95


def test_nothing_is_interpolated_without_a_lattice(band):
    _, lattice, judge = band
    assert np.isinf(judge(jax.tree.map(jnp.zeros_like, lattice)).variance).all()
