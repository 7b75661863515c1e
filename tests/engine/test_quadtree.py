"""Rays chosen by a quadtree: no pixel is over the tolerance, nothing is missed, and without a tolerance nothing is left out."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from images import layers

import jaxsph as js
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.screen.packets import QuadtreePlan
from jaxsph.numerics.checks import array_of

pytestmark = pytest.mark.usefixtures("quick_programs")

QUADTREE = {"screen": "quadtree", "leaf_pixels": 8}
ROUNDING = 1e-6


@pytest.fixture(scope="module")
def screened(frames):
    """Settings and plan of a quadtree for all random frames, whose rays are cast in several turns."""
    coarse = QuadtreePlan(8, ListPlan(1, 1, 4 * frames.capacity, 16 * frames.capacity), 3)
    plan = dataclasses.replace(frames.plan(), screen="quadtree", quadtree=coarse)
    return dataclasses.replace(frames.settings, **QUADTREE), plan


@pytest.fixture(scope="module")
def tolerant(screened):
    """The same with a tolerance: along rays there is none, so the plan is the same."""
    return dataclasses.replace(screened[0], tolerance=0.02), screened[1]


def agree(image, truth):
    np.testing.assert_allclose(layers(image), layers(truth), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(image.depth, truth.depth, rtol=1e-5)


def cloud(frames, rng, supports=5.0, extinction=0.4):
    """A smooth scene: all supports reach beyond what is seen, and colours are linear in the quantity."""
    scene = frames.scene(rng)
    particles = dataclasses.replace(scene.particles, support=array_of(np.full(frames.capacity, supports), np.float32))
    points = np.linspace(0, 1, 5)
    colors = np.stack([points, 0.5 + 0 * points, 1 - points], 1)
    transfer = js.TransferFunction.from_points(points, colors, np.full(5, extinction))
    return js.Scene(particles=particles, transfer=transfer)


def specks(frames, rng, camera, pixels=0.8):
    """As many particles as there is room for, each seen through a few pixels at most; far from each other in most cases."""
    scene, height = frames.scene(rng), 2 * float(camera.half_height) * 3 / frames.height
    support = array_of(np.where(np.arange(frames.capacity) < 8, pixels * height, 1e-3 * height), np.float32)
    transfer = dataclasses.replace(scene.transfer, extinction=np.full(5, 1e3, np.float32))
    return js.Scene(dataclasses.replace(scene.particles, support=support), transfer)


def test_another_tolerance_pose_or_particle_compiles_nothing(frames, tolerant, compiles):
    """However many rays that takes, in however many turns: here first in few, and of whole bundles alone."""
    rng = np.random.default_rng(0)
    js.render(cloud(frames, rng), frames.camera(rng), tolerant[0], plan=tolerant[1])
    compiles.clear()
    for tolerance, scene in ((0.001, frames.scene(rng)), (0.5, cloud(frames, rng)), (0.05, frames.scene(rng, decades=3))):
        js.render(scene, frames.camera(rng), dataclasses.replace(tolerant[0], tolerance=tolerance), plan=tolerant[1])
    assert not compiles


@pytest.mark.parametrize("distance", [3.0, pytest.param(0.2, marks=pytest.mark.slow)])
def test_without_a_tolerance_the_image_is_that_of_every_pixel(frames, screened, distance):
    """From outside and from among the particles; what is no ray's is empty for certain."""
    for seed in range(4):  # of specks, whose rays are cast one by one, at last
        rng = np.random.default_rng(seed)
        scene, camera = frames.scene(rng, decades=2), frames.camera(rng, distance=distance)
        scene = scene if seed < 3 else specks(frames, rng, camera)
        image = js.render(scene, camera, screened[0], plan=screened[1])
        truth = js.render(scene, camera, frames.settings, plan=frames.plan())
        agree(image, truth)
        assert not image.certified and float(np.abs(image.error_bound).max()) == 0
        np.testing.assert_array_equal(np.asarray(image.evaluations)[np.asarray(truth.alpha) > 0] > 0, True)
        assert image.stats["evaluations_full"] == truth.stats["evaluations"]


def test_of_a_volume_rays_are_those_of_every_pixel():
    """There they share no spheres, so bundles are cast in several packets of scattered rays, and whole ones ray by ray."""
    x, y, z = np.mgrid[-1:1:24j, -1:1:24j, -1:1:24j].astype(np.float32)
    volume = js.Volume.from_array(1 + np.sin(x + y) * np.cos(y - z) / 2, (-1, -1, -1), 2 / 23)
    transfer = js.TransferFunction.from_points([0, 1, 3], [[1, 0.2, 0], [0, 0.2, 1], [0, 1, 0]], [0.1, 0.3, 0.7])
    camera = js.Camera.framing(volume, direction=(0.2, 0.3, 1), fov_degrees=30, width=93, height=85)
    scene, settings = js.Scene(volume=volume, volume_transfer=transfer), js.Settings(samples=32)
    truth = js.render(scene, camera, settings)
    agree(js.render(scene, camera, dataclasses.replace(settings, **QUADTREE)), truth)
    image = js.render(scene, camera, dataclasses.replace(settings, **QUADTREE, tolerance=0.08))
    told = np.asarray(image.error_bound) == 0
    assert 0.2 < told.mean() < 0.9
    assert np.abs(layers(image) - layers(truth))[told].max() <= ROUNDING


def test_an_empty_scene_takes_no_ray(frames, screened):
    rng = np.random.default_rng(0)
    image = js.render(frames.scene(rng, count=0), frames.camera(rng), screened[0], plan=screened[1])
    assert image.stats["rays"] == 0 and not np.asarray(image.alpha).any() and np.isinf(image.depth).all()


def test_a_smooth_image_takes_few_rays_and_no_pixel_is_over_the_tolerance(frames, tolerant):
    """An estimate, which is 0 where there was a ray: there pixels are those of all rays."""
    rays = []
    for tolerance in (0.004, 0.01, 0.02):
        for seed in range(4):
            rng = np.random.default_rng(seed)
            scene, camera = cloud(frames, rng), frames.camera(rng)
            settings = dataclasses.replace(tolerant[0], tolerance=tolerance)
            image = js.render(scene, camera, settings, plan=tolerant[1])
            truth = js.render(scene, camera, frames.settings, plan=frames.plan())
            cast, bound = np.asarray(image.evaluations) > 0, np.asarray(image.error_bound)
            error = np.abs(layers(image) - layers(truth))
            assert error.max() <= tolerance and error[cast].max(initial=0) <= ROUNDING and not image.certified
            assert cast.sum() <= image.stats["rays"]  # a bundle that is cast whole has rays for pixels that had one
            assert not bound[cast].any() and (cast.all() or bound.any())
            rays.append(image.stats["rays"])
    assert sum(rays[-4:]) <= 0.7 * 4 * frames.width * frames.height
    assert sum(rays[:4]) >= sum(rays[4:8]) >= sum(rays[8:])


def test_specks_smaller_than_a_leaf_are_never_missed(frames, tolerant):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        camera = frames.camera(rng)
        scene = specks(frames, rng, camera)
        truth = js.render(scene, camera, frames.settings, plan=frames.plan())
        image = js.render(scene, camera, dataclasses.replace(tolerant[0], tolerance=0.3), plan=tolerant[1])
        assert 0 < (np.asarray(truth.alpha) > 0.1).sum() < 100
        assert np.abs(layers(image) - layers(truth)).max() <= 0.3


@pytest.mark.slow
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("size", [(1, 1), (37, 29), (64, 1), (1, 33)])  # those of several rows of tiles in bands
@pytest.mark.parametrize("leaf", [4, 16, 32])
def test_any_image_size_is_that_of_every_pixel(frames, projection, size, leaf):
    """Eagerly, with plans of their own."""
    rng = np.random.default_rng(0)
    shape = dataclasses.replace(frames, width=size[0], height=size[1])
    scene, camera = shape.scene(rng), shape.camera(rng, projection)
    settings = dataclasses.replace(frames.settings, screen="quadtree", leaf_pixels=leaf)
    if camera.height > 16:
        settings = dataclasses.replace(settings, memory_limit=js.plan(scene, camera, settings).bytes - 1)
        assert js.plan(scene, camera, settings).bands > 1
    agree(js.render(scene, camera, settings), js.render(scene, camera, frames.settings))


@pytest.mark.slow
@pytest.mark.parametrize("estimator", [None, "pilot"])
@pytest.mark.parametrize("name", ["mixer", "radial"])
def test_of_built_in_scenes_at_most_one_pixel_in_a_thousand_is_over(name, estimator):
    scene, camera = js.scenes.load(name, particles=30_000, width=160, height=130)
    truth = js.render(scene, camera, js.Settings(samples=96))
    for tolerance in (0.01, 0.04):
        image = js.render(scene, camera, js.Settings(samples=96, tolerance=tolerance, estimator=estimator, **QUADTREE))
        assert (np.abs(layers(image) - layers(truth)).max(-1) > tolerance).mean() <= 1e-3


def test_rays_of_segments_are_refined_for_their_half(frames):
    """Kratz et al. 2011, equations 7 and 8: pixels are held against the light integral, and rays take a half at most."""
    over, saved = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scene, camera = cloud(frames, rng, supports=2.0), frames.camera(rng)
        truth = layers(js.reference.integral(scene, camera))
        for tolerance in (0.004, 0.02):
            settings = dataclasses.replace(frames.settings, **QUADTREE, integrator="segments", tolerance=tolerance)
            image = js.render(scene, camera, settings)
            error, bound = np.abs(layers(image) - truth).max(-1), np.asarray(image.error_bound)
            over.append((error > tolerance).mean())
            assert bound.max() <= tolerance and bound.min() > 0 and not image.certified
            saved.append(float(np.asarray(image.evaluations).sum()))
    assert max(over) <= 1e-2 and np.mean(over) <= 1e-3
    assert sum(saved[1::2]) < 0.7 * sum(saved[::2])


def test_jumps_add_nothing_to_estimates(frames, screened):
    """Rays of points are at full rate, and errors estimates: whether rounding may choose a side is of certificates alone."""
    rng = np.random.default_rng(0)
    scene, camera = cloud(frames, rng), frames.camera(rng)
    values = np.float32([0, 0.5, 0.5, 0.75, 1])
    quantity = np.full(frames.capacity, 0.5, np.float32)
    quantity[::2] = np.nextafter(np.float32(0.5), np.float32(0))
    particles = dataclasses.replace(scene.particles, quantity=quantity)
    scene = js.Scene(particles=particles, transfer=dataclasses.replace(scene.transfer, values=values))
    assert np.isinf(js.render(scene, camera, frames.settings, plan=frames.plan()).error_bound).any()
    image = js.render(scene, camera, screened[0], plan=screened[1])
    assert not np.asarray(image.error_bound).any()


def test_estimators_that_a_quadtree_has_no_use_for_are_refused(frames):
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng), frames.camera(rng)
    for given in ({"estimator": "interval"}, {"relax": 0.5}):
        with pytest.raises(ValueError, match="does not serve `screen"):
            js.render(scene, camera, js.Settings(tolerance=0.01, **QUADTREE, **given))


@pytest.mark.parametrize("other", [{"leaf_pixels": 16}, {"screen": "pixels"}, {"integrator": "segments"}])
def test_a_plan_for_other_leaves_is_refused_by_name(frames, screened, other):
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=f"settings.{next(iter(other))} = .*make a new one"):
        js.render(frames.scene(rng), frames.camera(rng), dataclasses.replace(screened[0], **other), plan=screened[1])


def test_rooms_of_the_first_lattice_grow_with_a_plan(frames):
    rng = np.random.default_rng(0)
    settings, camera = dataclasses.replace(frames.settings, **QUADTREE), frames.camera(rng)
    few, many = frames.scene(rng, decades=2), cloud(frames, rng)
    small, large = (js.plan(scene, camera, settings) for scene in (few, many))
    assert large.quadtree.lists.list_capacity > small.quadtree.lists.list_capacity
    grown = js.plan(many, camera, settings, like=small)
    for name in ("tile_capacity", "list_capacity"):
        assert getattr(grown.quadtree.lists, name) >= getattr(large.quadtree.lists, name)
    assert grown != small and grown.serves(small) and not small.serves(grown)
    assert all(js.plan(scene, camera, settings, like=grown) is grown for scene in (few, many))
    lists = dataclasses.replace(grown.quadtree.lists, tile_capacity=1, list_capacity=1)
    assert not dataclasses.replace(grown, quadtree=dataclasses.replace(grown.quadtree, lists=lists)).serves(grown)
