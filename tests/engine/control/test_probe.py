"""The probe asks for an analysis where it could pay: where quantities hardly vary, or everything is opaque."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.control.probe import probe, worthwhile
from jaxsph.engine.control.ranges import tables_of_parts


@pytest.fixture(scope="module")
def probed(frames, stages):
    """Which cells are promising, of particles with given quantities and a transfer function with given extinction."""
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng, decades=0.3), frames.camera(rng), frames.plan()
    run = jax.jit(functools.partial(probe, slab_samples=4, cells_at_once=64))

    def look(quantity, extinction, tolerance):
        particles = js.Particles(**{**vars(scene.particles), "quantity": jnp.asarray(quantity, jnp.float32)})
        transfer = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 0], [1, 1, 1]], [extinction, extinction])
        grid, _ = stages(particles, camera, plan=plan)
        found = run(grid, tables_of_parts(transfer), jnp.float32(tolerance))
        count = np.pad(np.asarray(grid.windows.count), ((0, -grid.windows.count.shape[0] % 4), (0, 0)))
        return found, count.reshape(-1, 4, count.shape[1]).sum(1)

    return look


ALIKE, MIXED = np.full(24, 0.5), np.tile([0.0, 1.0], 12)


def test_where_all_is_alike_every_filled_cell_is_promising(probed):
    found, count = probed(ALIKE, 1.0, 1e-3)
    np.testing.assert_array_equal(found.promising, count > 0)
    assert float(found.held) == float(found.all_held) == count.sum() > 0


def test_where_neighbours_differ_few_are_and_more_with_a_larger_tolerance(probed):
    strict, count = probed(MIXED, 1.0, 1e-3)
    loose, _ = probed(MIXED, 1.0, 0.2)
    assert strict.promising.sum() < 0.5 * (count > 0).sum()
    assert (np.asarray(loose.promising) | ~np.asarray(strict.promising)).all() and loose.promising.sum() > strict.promising.sum()


def test_opaque_bundles_are_promising_whole(probed):
    found, count = probed(MIXED, 1e4, 1e-3)
    opaque = np.asarray(found.promising).any(0)
    assert opaque.any()
    np.testing.assert_array_equal(np.asarray(found.promising)[:, opaque], (count > 0)[:, opaque])


@pytest.mark.parametrize(("held", "pays"), [(0.099, False), (0.101, True), (1.0, True)])
def test_the_share_of_promising_work_decides_over_all_shards(held, pays):
    shards = [(jnp.float32(2 * held), jnp.float32(1.0)), (jnp.float32(0.0), jnp.float32(1.0))]
    assert bool(worthwhile(shards)) == pays
