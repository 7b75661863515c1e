"""Where nothing is known, nothing is interpolated; and what is judged, is judged by what lies around it."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.control.interpolation_error import SUBSAMPLED_SHARE, interpolation_error
from jaxsph.engine.field.lattice import GAP, Region
from jaxsph.engine.field.schedule import FINEST, Spacing
from jaxsph.engine.frame.stages import sum_shard


@pytest.fixture(scope="module")
def band(stages):
    scene, camera = js.scenes.load("checker_board", 3000, width=150, height=130)
    plan = js.plan(scene, camera, js.Settings(samples=96, tolerance=0.05, estimator="pilot"))
    grid, _ = stages(scene.particles, camera, plan=plan)
    sizes = {"lists": plan.lists, "cast": plan.cast, "control": plan.control, "tuning": plan.cast.tuning}
    lattice = sum_shard(grid, camera, scene.transfer, jnp.int32(0), shards=1, kernel=scene.particles.kernel, **sizes)
    judge = jax.jit(functools.partial(interpolation_error, slab_samples=plan.cast.slab_samples), compiler_options=QUICKLY)
    return grid, lattice, lambda lattice: jax.tree.map(np.asarray, judge(grid, lattice, camera, scene.transfer))


def test_some_slabs_with_particles_can_be_interpolated(band):
    grid, lattice, judge = band
    found = judge(lattice)
    filled = np.asarray(grid.windows.count) > 0
    usable = np.isfinite(found.variance)
    assert (usable & filled).sum() > 0.1 * filled.sum()
    assert (np.asarray(found.variance)[usable] > 0).all() and (np.asarray(found.bend) >= 0).all()
    share = np.asarray(found.subsampled_share)[usable]
    assert (share > 0).all() and (share <= np.float32(SUBSAMPLED_SHARE)).all() and share.min() < share.max()


def test_rougher_sums_are_judged_worse(band):
    _, lattice, judge = band
    (weighted,) = lattice.weighted
    rough = np.asarray(weighted) * (1 + 0.1 * np.random.default_rng(0).normal(size=weighted.shape)).astype(np.float32)
    smooth, found = judge(lattice).variance, judge(dataclasses.replace(lattice, weighted=(rough,))).variance
    both = np.isfinite(smooth) & np.isfinite(found) & (np.asarray(smooth) > 1e-9)
    assert both.any() and (np.asarray(found)[both] > np.asarray(smooth)[both]).mean() > 0.95


def test_nothing_is_interpolated_without_a_lattice(band):
    _, lattice, judge = band
    assert np.isinf(judge(jax.tree.map(np.zeros_like, lattice)).variance).all()


@pytest.mark.parametrize("nodes", [FINEST, Spacing(8, 2)])
def test_what_would_be_interpolated_from_beyond_the_lattice_is_not(band, nodes):
    """Even where sums fall off so evenly that nodes which are missing look like zero."""
    grid, lattice, judge = band
    region = Region(np.int32(0), np.int32(0), 12, 13, nodes)
    layers, down, across = lattice.weight.shape[0], 12 * nodes.across, 13 * nodes.across
    ramp = np.zeros((layers, down + GAP, across + GAP), np.float32)
    ramp[:, :down, :across] = across - np.arange(across)
    even = dataclasses.replace(lattice, weight=ramp, weighted=(np.float32(0.3) * ramp,), region=region)
    row, column, inside = (np.asarray(value) for value in jax.jit(Region.place)(region, grid))
    usable = np.isfinite(judge(even).variance).any(0)
    last = (column + 1) * nodes.across + 1, (row + 1) * nodes.across + 1  # nodes that a cubic takes
    assert usable.any() and inside[usable].all() and (row[usable] > 0).all() and (column[usable] > 0).all()
    assert (last[0][usable] < across).all() and (last[1][usable] < down).all()
