"""Parts of the rows see what the whole band does."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.control.residuals import all_rows, residuals
from jaxsph.stages import sum_part


@pytest.fixture(scope="module")
def band(stages):
    scene, camera = js.scenes.load("checker_board", 3000, width=150, height=130)
    plan = js.plan(scene, camera, js.Settings(samples=96, tolerance=0.05, estimator="pilot"))
    grid, _ = stages(scene.particles, camera, plan=plan)
    lattice = sum_part(grid, camera, scene.transfer, jnp.int32(0), parts=1, plan=plan, kernel=scene.particles.kernel)
    judge = jax.jit(functools.partial(residuals, slab_samples=plan.cast.slab_samples), static_argnames="parts")
    return grid, lattice, judge, (camera, scene.transfer)


@pytest.mark.parametrize("parts", [2, 3, 4])
def test_parts_are_joined_to_the_whole(band, parts):
    grid, lattice, judge, view = band
    bundles = grid.cells.count.shape[1]
    whole = all_rows((judge(grid, lattice, *view),), bundles)
    assert np.isfinite(whole.variance).any()
    found = all_rows(tuple(judge(grid, lattice, *view, nth=jnp.int32(k), parts=parts) for k in range(parts)), bundles)
    np.testing.assert_array_equal(np.isfinite(found.variance), np.isfinite(whole.variance))
    for name in ("variance", "bend"):
        np.testing.assert_allclose(getattr(found, name), getattr(whole, name), rtol=1e-4, atol=1e-12)


def test_nothing_is_interpolated_without_a_lattice(band):
    grid, lattice, judge, view = band
    empty = jax.tree.map(jnp.zeros_like, lattice)
    assert np.isinf(judge(grid, empty, *view).variance).all()
