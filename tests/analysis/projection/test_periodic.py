"""Projections of periodic sets along an axis of their box, against copies of all particles."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.analysis.projection.plan import plan_projection

pytestmark = pytest.mark.usefixtures("quick_programs")
SIZE = {"width": 20, "height": 13}


def periodic(count=60, seed=17):
    """And its 27 copies, those in the box first; on a grid of 2^-12, so that no copy is rounded."""
    rng, sides = np.random.default_rng(seed), np.array([1.5, 1.0, 0.75])
    position = np.floor(rng.uniform(0, 1, (count, 3)) * sides * 4096) / 4096
    others = rng.uniform(0.05, 0.4, count), rng.uniform(-1, 1, count), rng.uniform(0.1, 1, count)
    turns = sorted(itertools.product((-1, 0, 1), repeat=3), key=any)
    copies = np.concatenate([position + sides * turn for turn in turns])
    one = js.Particles.from_arrays(position, *others, "cubic_spline", box=sides)
    return one, js.Particles.from_arrays(copies, *(np.tile(column, 27) for column in others), "cubic_spline")


@pytest.mark.slow
@pytest.mark.parametrize("pixel", ["mean", "ray"])
def test_along_an_axis_a_periodic_set_is_its_copies_between_the_faces(pixel):
    particles, copies = periodic(25)
    camera = js.Camera.along_axis(particles, "z", 18, 12)  # pixels end at the faces
    truth = js.reference.project(copies, camera, pixel=pixel, depth_range=(0.375, 1.125), subrays=10).values
    image = js.project(particles, camera, pixel=pixel)
    np.testing.assert_allclose(image.values, truth, atol=3e-4 * truth.max())
    if pixel == "mean":
        assert abs(float(image.total()) / particles.to_numpy()["volume"].sum() - 1) < 1e-4
        return
    part = js.project(particles, camera, pixel=pixel, depth_range=(0.2, 0.8))
    slab = js.reference.project(copies, camera, pixel=pixel, depth_range=(0.375, 0.8)).values
    np.testing.assert_allclose(part.values, slab, atol=3e-5 * truth.max())


@pytest.mark.slow
def test_pixels_beyond_the_faces_hold_nothing_and_those_across_them_a_part():
    particles, _ = periodic()
    wide = js.Camera.orthographic((0.75, 0.5, 3), (0.75, 0.5, 0), view_height=1.3, near=1, far=5, **SIZE)
    image = js.project(particles, wide)
    assert abs(float(image.total()) / particles.to_numpy()["volume"].sum() - 1) < 2e-2  # of those a part is as full as the whole
    values = np.asarray(image.values)
    assert (values[0] == 0).all() and (values[:, 0] == 0).all() and (values[2:-2, 4:-4] > 0).all()
    nothing = js.project(particles, wide, depth_range=(1, 2))
    assert (np.asarray(nothing.values) == 0).all()


def test_rays_from_face_to_face_need_no_images_along_themselves():
    """The sum over periods of what lies between the faces is each particle's whole column; not of rays that end between."""
    particles, _ = periodic()
    camera = js.Camera.along_axis(particles, "y", 18, 12)
    cut = dataclasses.replace(camera, near=camera.near + 0.3)
    plan, of_part = (plan_projection(particles, view) for view in (camera, cut))
    assert plan.through == 1 and of_part.through is None and plan.images < of_part.images and "cut" not in dict(plan.lists)
    under_jit = jax.jit(lambda view: js.project(particles, view, plan=plan), compiler_options=QUICKLY)
    image, middle = under_jit(camera).check(), camera.near + 0.5 * (camera.far - camera.near)
    halves = [dataclasses.replace(camera, **end) for end in ({"far": middle}, {"near": middle})]
    of_halves = plan_projection(particles, halves[1], like=plan_projection(particles, halves[0]))
    of_half = jax.jit(lambda view: js.project(particles, view, plan=of_halves).values, compiler_options=QUICKLY)
    first, rest = map(of_half, halves)
    np.testing.assert_allclose(image.values, first + rest, atol=3e-4 * float(image.values.max()))
    with pytest.raises(js.CapacityError):
        under_jit(cut).check()


def test_other_cameras_see_each_particle_of_a_periodic_set_once():
    particles, _ = periodic()
    aslant = js.Camera.orthographic((3, 2, 4), (0.75, 0.5, 0.4), view_height=3.5, near=0.5, far=9, **SIZE)
    image = js.project(particles, aslant)
    assert plan_projection(particles, aslant).images is None
    assert abs(float(image.total()) / particles.to_numpy()["volume"].sum() - 1) < 1e-4
    outside = dataclasses.replace(particles, position=particles.position + particles.box.sides)
    np.testing.assert_allclose(js.project(outside, aslant).values, image.values, atol=1e-3 * float(image.values.max()))


@pytest.mark.slow
def test_a_plan_for_a_periodic_set_grows_and_is_for_periodic_sets():
    camera = js.Camera.along_axis(periodic()[0], "z", 20, 13)
    few, many = (periodic(count)[0].padded(64) for count in (20, 60))
    small, large = (plan_projection(particles, camera) for particles in (few, many))
    grown = plan_projection(many, camera, like=small)
    assert grown.images == large.images > small.images and plan_projection(few, camera, like=grown) == grown
    with pytest.raises(ValueError, match="for a periodic box, and these have none"):
        js.project(dataclasses.replace(many, box=None), camera, plan=grown)
    with pytest.raises(js.CapacityError):
        js.project(many, camera, plan=dataclasses.replace(large, images=3))
