"""What `evaluations` counts, counted again particle by particle: every 'times fewer' rests on it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import nnls

import jaxsph as js
from jaxsph.reference.where import ray_coordinates, to_view

pytestmark = pytest.mark.usefixtures("quick_programs")

SLAB = 4


def placed(frames, camera, rng, decades):
    """Particles that lie between near and far as a whole, each wider than a pixel: so that no border but their own counts."""
    scene = frames.scene(rng, decades=decades)
    support = np.asarray(scene.particles.support) * 0.5 + 0.25
    depth, reach = (
        rng.uniform(float(camera.near) + 0.8, float(camera.far) - 0.8, frames.capacity),
        rng.uniform(-1, 1, (2, frames.capacity)),
    )
    place = np.stack([*reach, depth], 1) @ np.asarray(camera.axes) + np.asarray(camera.eye)
    particles = js.Particles.from_arrays(place.astype(np.float32), support, np.asarray(scene.particles.quantity))
    return dataclasses.replace(scene, particles=particles)


def seen_by_bundles(scene, camera):
    """Whether a sphere meets the pyramid of a bundle, and some of its columns and rows of rays: (particles, rows, columns)."""
    view = to_view(scene.particles.exact_position(), camera)
    support = np.asarray(scene.particles.support, np.float64)
    u, v = ray_coordinates(camera, np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)

    def off(place, rays):
        """Distance to each of the planes of rays."""
        across = np.abs(place[:, None] - rays * (view[:, 2:] if camera.is_perspective else 1))
        return across / (np.sqrt(1 + rays**2) if camera.is_perspective else 1)

    columns, rows = (off(view[:, k], rays) <= support[:, None] for k, rays in ((0, u), (1, v)))
    found = np.zeros((len(view), -(-camera.height // 8), -(-camera.width // 8)), bool)
    for row, column in np.ndindex(found.shape[1:]):
        across, down = slice(8 * column, 8 * column + 8), slice(8 * row, 8 * row + 8)
        # a bundle has eight rays each way, those beyond the image too
        ends = ray_coordinates(camera, 8 * column + np.array([0.5, 7.5]), 8 * row + np.array([0.5, 7.5]))
        for k, place in enumerate(view):
            inside = columns[k, across].any() and rows[k, down].any()
            found[k, row, column] = inside and distance(place, *ends, camera.is_perspective) <= support[k]
    return found


def distance(place, across, down, perspective):
    """From a place to the pyramid, or to the box, between rays."""
    if perspective:
        return nnls(np.array([[x, y, 1] for x in across for y in down]).T, place)[1]
    x, y = place[0] - np.clip(place[0], *sorted(across)), place[1] - np.clip(place[1], *sorted(down))
    return np.hypot(x, y)


def near_slabs(scene, camera, depths, num_classes):
    """Whether a particle of a class can touch a slab as far as the widest of the class reaches: (particles, slabs)."""
    z = to_view(scene.particles.exact_position(), camera)[:, 2]
    support = np.asarray(scene.particles.support, np.float64)
    octave = np.minimum(np.floor(np.log2(support.max() / support)), num_classes - 1)
    widest = np.array([support[octave == own].max() for own in octave])[:, None]
    first, last = depths[::SLAB], np.append(depths[SLAB - 1 :: SLAB], depths[-1:])[: -(-len(depths) // SLAB)]
    return (z[:, None] - widest <= last) & (z[:, None] + widest >= first)


def counted(scene, camera, samples, num_classes):
    """Kernel evaluations of every pixel at full rate, and pairs of particles and bundles."""
    depths = js.reference.sample_depths(camera, samples)
    seen, near = seen_by_bundles(scene, camera), near_slabs(scene, camera, depths, num_classes)
    in_slab = np.minimum(SLAB, samples - SLAB * np.arange(near.shape[1]))
    of_bundles = np.einsum("kij,ks,s->ij", seen, near, in_slab)
    return np.repeat(np.repeat(of_bundles, 8, 0), 8, 1)[: camera.height, : camera.width], seen.sum()


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("decades", [0.0, 1.0])
def test_evaluations_are_candidates_of_a_bundle_in_a_slab_times_its_samples_and_rays(frames, projection, decades):
    rng = np.random.default_rng(0)
    camera = frames.camera(rng, projection)
    scene, plan = placed(frames, camera, rng, decades), frames.plan(SLAB)
    image = js.render(scene, camera, frames.settings, plan=plan)
    wanted, pairs = counted(scene, camera, frames.samples, plan.num_classes)
    np.testing.assert_array_equal(image.evaluations, wanted)
    assert wanted.min() < wanted.max()
    assert image.stats["evaluations"] == image.stats["evaluations_full"] == wanted.sum()
    assert image.stats["pairs"] == pairs


def test_they_are_no_fewer_than_those_that_the_reference_cannot_do_without(frames):
    """The reference evaluates a particle in the box of samples around it: the cells of a bundle hold more, by a stated factor."""
    rng = np.random.default_rng(1)
    scene, camera = frames.scene(rng), frames.camera(rng)
    image = js.render(scene, camera, frames.settings, plan=frames.plan(SLAB))
    least = js.reference.render(scene, camera, frames.settings).stats["evaluations"]
    assert least <= image.stats["evaluations"] <= 4 * least
