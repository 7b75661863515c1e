"""The probe asks for an analysis where it could pay: where quantities hardly vary, or everything is opaque."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.control.adapt import MIN_PROMISING_SHARE, probe
from jaxsph.engine.control.ranges import tables_of_parts


@pytest.fixture(scope="module")
def probed(frames, stages):
    """Which cells are promising, of particles with given quantities and a transfer function with given extinction."""
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng, decades=0.3), frames.camera(rng), frames.plan()

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def run(grid, transfer, tolerance):
        return probe(grid, tables_of_parts(transfer), tolerance, slab_samples=4, cells_at_once=64)

    def look(quantity, extinction, tolerance):
        particles = js.Particles(**{**vars(scene.particles), "quantity": np.float32(quantity)})
        transfer = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 0], [1, 1, 1]], [extinction, extinction])
        grid, _ = stages(particles, camera, plan=plan)
        found = np.asarray(run(grid, transfer, np.float32(tolerance)))
        count = np.pad(np.asarray(grid.windows.count), ((0, -grid.windows.count.shape[0] % 4), (0, 0)))
        return found, count.reshape(-1, 4, count.shape[1]).sum(1)

    return look


ALIKE, MIXED = np.full(24, 0.5), np.tile([0.0, 1.0], 12)


def test_where_all_is_alike_every_filled_cell_is_promising(probed):
    found, count = probed(ALIKE, 1.0, 1e-3)
    np.testing.assert_array_equal(found, count > 0)
    assert count.sum() > 0


def test_opaque_bundles_are_promising_whole(probed):
    found, count = probed(MIXED, 1e4, 1e-3)
    opaque = np.asarray(found).any(0)
    assert opaque.any()
    np.testing.assert_array_equal(np.asarray(found)[:, opaque], (count > 0)[:, opaque])


def test_more_promises_with_a_larger_tolerance_and_a_tenth_of_the_work_or_none_of_it(probed):
    held, before = [], np.bool_(False)
    for tolerance in (1e-3, 0.01, 0.05, 0.2):
        found, count = probed(MIXED, 1.0, tolerance)
        assert (np.asarray(found) | ~before).all()
        held.append(count[np.asarray(found)].sum() / count.sum())
        before = np.asarray(found)
    assert held[0] == 0 and any(MIN_PROMISING_SHARE <= share < 1 for share in held), held
    assert all(share == 0 or share >= MIN_PROMISING_SHARE for share in held), held
