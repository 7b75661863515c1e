"""Nodes hold the sums of full rate, and so do the rays at which slabs are subsampled; between, cubics are met."""

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
    region_of,
    sum_at_nodes,
)
from jaxsph.engine.field.tasks import FINEST, MAX_SPACING_LEVEL, SUBSAMPLE, RayPackets, Spacing, full_rate
from jaxsph.model.particles import kernels

WIDER = Spacing(8, 4)
rays = jax.jit(lambda camera, columns, rows: (camera.column(columns), camera.row(rows)))
node_sums = jax.jit(sum_at_nodes, static_argnums=(2, 3, 6), compiler_options=QUICKLY)


@pytest.mark.parametrize("spacing", [FINEST, WIDER])
def test_the_sums_at_nodes_are_those_over_all_particles(frames, stages, x64, spacing):
    rng = np.random.default_rng(5)
    scene, camera = frames.scene(rng, decades=0.5, dtype=np.float64), frames.camera(rng, dtype=np.float64)
    plan = js.plan(scene, camera, frames.settings)
    grid, _ = stages(scene.particles, camera, plan=plan)
    ordered = grid.ordered
    lattice = node_sums(
        grid,
        camera,
        scene.particles.kernel,
        plan.cast.slab_samples,
        Region(np.int32(0), np.int32(0), *plan.lists.bundles, spacing),
        (np.float64(0.4),),
        plan.cast.tuning.cells_of_nodes,
    )

    lattice, kept = jax.tree.map(np.asarray, lattice), (slice(REACH, -GAP), slice(-GAP), slice(-GAP))
    deep, down, across = lattice.weight[kept].shape
    deep = min(deep, -(-plan.samples // spacing.samples))
    depth = np.asarray(grid.half_steps)[1::2][:: spacing.samples][:, None, None]
    u, v = map(np.asarray, rays(camera, spacing.pixels * np.arange(across) + 0.5, spacing.pixels * np.arange(down) + 0.5))
    v = v[:, None]
    spread = depth if camera.is_perspective else np.ones_like(depth)
    smooth, weight, weighted = kernels.by_name(scene.particles.kernel), 0.0, 0.0
    x, y, z, scale, size, quantity = (
        np.asarray(c)[np.asarray(ordered.live)]
        for c in (ordered.x, ordered.y, ordered.z, ordered.scale, ordered.size, ordered.quantity)
    )
    for k in range(len(x)):
        square = ((u * spread - x[k]) ** 2 + (v * spread - y[k]) ** 2 + (depth - z[k]) ** 2) * scale[k] ** 2
        w = smooth.weigh(smooth.prepare(square, size[k]), 0.0, size[k], np)
        weight, weighted = weight + w, weighted + w * (quantity[k] - float(lattice.references[0]))
    # nodes beyond the image lie in bundles that it has no list for
    rows, columns = -(-camera.height // spacing.pixels), -(-camera.width // spacing.pixels)
    for found, wanted in ((lattice.weight, weight), (*lattice.weighted, weighted)):
        assert (found != 0).sum() == (found[kept] != 0).sum(), "margins are zero"
        np.testing.assert_allclose(found[kept][:deep, :rows, :columns], wanted[:deep, :rows, :columns], rtol=1e-9, atol=1e-12)
    assert weight.max() > 0


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


@pytest.mark.slow
def test_a_region_with_little_room_holds_the_same_nodes(frames, stages):
    """As far as it reaches: from the first row and column of bundles that are touched."""
    rng = np.random.default_rng(5)
    scene, camera = frames.scene(rng, decades=0.5), frames.camera(rng)
    plan = js.plan(scene, camera, frames.settings)
    grid, _ = stages(scene.particles, camera, plan=plan)
    every, some = Region(jnp.int32(0), jnp.int32(0), *plan.lists.bundles, FINEST), region_of(grid, 2, 3, FINEST)
    kept = slice(None), slice(-GAP), slice(-GAP)
    sizes = (jnp.float32(0.4),), plan.cast.tuning.cells_of_nodes
    whole, part = (
        sum_at_nodes(grid, camera, scene.particles.kernel, plan.cast.slab_samples, region, *sizes).weight[kept]
        for region in (every, some)
    )
    row, column = int(some.row) // FINEST.pixels, int(some.column) // FINEST.pixels
    np.testing.assert_array_equal(part, whole[:, row : row + part.shape[1], column : column + part.shape[2]])
    assert part.shape[1:] == (4, 6) and (part > 0).any()


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
