"""Nodes tell how steep the transfer function is around them; where nothing is known, nothing is interpolated."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.control.interpolation_error import (
    BUCKETS,
    SUBSAMPLED_SHARE,
    interpolation_error,
    mean_square_slope,
    squared_slopes,
)
from jaxsph.engine.control.pilot import sum_shard
from jaxsph.engine.field.lattice import GAP, Region
from jaxsph.engine.field.tasks import FINEST, Spacing


@pytest.fixture(scope="module")
def band(stages):
    scene, camera = js.scenes.load("checker_board", 3000, width=150, height=130)
    plan = js.plan(scene, camera, js.Settings(samples=96, tolerance=0.05, estimator="pilot"))
    grid, _ = stages(scene.particles, camera, plan=plan)
    sizes = {"lists": plan.lists, "slab_samples": plan.cast.slab_samples, "control": plan.control, "tuning": plan.cast.tuning}
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


RANGES = 8  # of a program


@functools.partial(jax.jit, compiler_options=QUICKLY)
def steepness_of(transfer, low, high):
    return jnp.stack(mean_square_slope(squared_slopes(transfer), low, high))


def steepness(transfer, low, high):
    """Of up to `RANGES` ranges."""
    padded = (np.pad(end, (0, RANGES - len(end)), mode="edge") for end in (low, high))
    return np.asarray(steepness_of(transfer, *padded))[:, : len(low)]


def test_mean_square_slopes_lie_between_those_of_the_range_and_of_its_buckets():
    transfer = js.TransferFunction.from_points(
        np.float32([0, 0.2, 0.5, 1]), np.float32([[0, 0, 0], [1, 0, 0], [0, 0.5, 0], [0, 1, 1]]), np.float32([0, 3, 3, 1])
    )
    low, high = np.float32([-0.5, 0.05, 0.1, 0.3, 0.9, 1.2, 0.3, -2]), np.float32([-0.1, 0.1, 0.4, 2.0, 0.9, 1.4, 0.45, 3])
    found = steepness(transfer, low, high)
    table = np.concatenate([np.asarray(transfer.colors), np.asarray(transfer.extinction)[:, None]], 1)
    steep = np.zeros((5, 4))
    steep[1:4] = np.diff(table, axis=0) / np.diff(np.asarray(transfer.values))[:, None]
    for i, (a, b) in enumerate(zip(low, high, strict=True)):
        width = 1 / BUCKETS
        least, most = (
            (steep[np.searchsorted(np.asarray(transfer.values), q, side="right")] ** 2).mean(0) * (q[-1] - q[0])
            for q in (np.linspace(a - out, max(b, a + 1e-6) + out, 40000) for out in (0, width))
        )
        extent = max(b - a, width)
        assert (found[:, i] >= least / extent * 0.995 - 1e-3).all(), i
        assert (found[:, i] <= most / extent * 1.005 + 1e-2).all(), i  # with what a difference of integrals may have lost


@pytest.mark.parametrize("values", [[0, 0.5, 0.5, 1], [0.5, 0.5], [0, 0, 0.5, 1], [0, 0.5, 1, 1]])
def test_what_holds_a_jump_is_infinitely_steep_and_what_does_not_is_not(values):
    values = np.float32(values)
    colors = np.linspace(0, 1, len(values), dtype=np.float32)[:, None] * np.ones(3, np.float32)
    transfer = js.TransferFunction.from_points(values, colors, np.float32(colors[:, 0]))
    at = values[np.flatnonzero(np.diff(values) == 0)[0]]
    low, high = np.float32([at - 0.1, at - 0.4, at + 0.1]), np.float32([at + 0.1, at - 0.1, at + 0.4])
    for channel in steepness(transfer, low, high):
        assert np.isinf(channel).tolist() == [True, False, False]
