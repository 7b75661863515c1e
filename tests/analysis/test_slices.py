"""Slices: the field on a plane as the reference has it, nowhere else anything, of periodic sets and within clips, too."""

import dataclasses
import itertools

import numpy as np
import pytest

import jaxsph as js
from jaxsph.analysis.slices import Slice

SIZE = {"width": 24, "height": 17}
SIDES = np.array([1.0, 1.4, 0.9])


def particles_of(box=None, dtype=np.float32, quantity=None):
    rng = np.random.default_rng(2)
    position = rng.uniform(0, 1, (150, 3)) * SIDES
    quantity = 5 + rng.normal(size=150) if quantity is None else quantity
    columns = position, rng.uniform(0.1, 0.25, 150), quantity, rng.uniform(0.1, 1, 150)
    return js.Particles.from_arrays(*(column.astype(dtype) for column in columns), box=box)


def truth_of(particles, found):
    """The oracle at the middle of one sample of each ray, in float64."""
    weighted, weight, _ = js.reference.field(js.Scene(particles=particles), found.camera, 1)
    weighted, weight = weighted[..., 0], weight[..., 0]
    return np.where(weight > 0, weighted / np.where(weight > 0, weight, 1), np.nan)


def agree(values, truth, atol):
    """But for samples within rounding of a support's edge."""
    assert (np.isnan(values) != np.isnan(truth)).sum() <= 1
    both = np.isfinite(values) & np.isfinite(truth)
    np.testing.assert_allclose(values[both], truth[both], rtol=0, atol=atol)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, -2, 0), (1, 0.4, -2)])
def test_values_are_those_of_the_reference_and_nothing_where_nothing_is(normal):
    particles, plane = particles_of(), js.Plane((0.5, 0.6, 0.4), normal)
    found = js.slice(particles, plane, **SIZE)
    truth = truth_of(particles, found)
    assert 0.05 < np.isnan(truth).mean() < 0.9
    agree(found.values, truth, 1e-5 * np.ptp(particles.to_numpy()["quantity"]))


def test_places_are_on_the_plane_one_pixel_apart_and_where_values_are():
    point, normal = np.array([0.5, 0.6, 0.4]), np.array([1, 0.4, -2.0]) / np.linalg.norm([1, 0.4, -2])
    found = js.slice(particles_of(), js.Plane(point, normal), view_height=1.0, center=(0.5, 0.5, 0.5), **SIZE)
    place = found.positions()
    assert np.abs((place - point) @ normal).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(np.diff(place, axis=0), axis=-1), 1 / 17, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(np.diff(place, axis=1), axis=-1), 1 / 17, rtol=1e-5)
    particles = particles_of().to_numpy()
    away = np.linalg.norm(place[..., None, :] - particles["position"], axis=-1) / particles["support"]
    assert (np.isfinite(found.values) == (away < 1).any(-1)).mean() > 0.99
    assert place[0, 0] @ np.asarray(found.camera.axes)[1] > place[-1, 0] @ np.asarray(found.camera.axes)[1]  # row 0 is the top


def test_double_precision_is_exact(x64):
    particles = particles_of(dtype=np.float64)
    found = js.slice(particles, js.Plane(np.array([0.5, 0.6, 0.4]), np.array([0, 0, 1.0])), **SIZE)
    assert found.values.dtype == np.float64
    agree(found.values, truth_of(particles, found), 1e-10)


@pytest.mark.parametrize("height", [0.45, 0.02], ids=["middle", "face"])
def test_of_a_periodic_set_images_count_and_there_is_nothing_outside_of_its_box(height):
    particles = particles_of(SIDES)
    found = js.slice(particles, js.Plane((0, 0, height), (0, 0, 1)), view_height=1.8, **SIZE)
    copies = [particles.exact_position() + SIDES * turns for turns in itertools.product((-1, 0, 1), repeat=3)]
    columns = {name: np.tile(column, 27) for name, column in particles.to_numpy().items() if name != "position"}
    free = js.Particles.from_arrays(np.concatenate([copy[:150] for copy in copies]), **columns)
    place = found.positions()
    inside = ((place >= 0) & (place <= SIDES)).all(-1)
    assert 0.1 < inside.mean() < 0.9
    assert np.isnan(found.values[~inside]).all()
    agree(np.where(inside, found.values, np.nan), np.where(inside, truth_of(free, found), np.nan), 1e-4)


def test_within_a_clip_values_stay_and_there_are_none_outside():
    particles, plane, ball = particles_of(), js.Plane((0.5, 0.6, 0.4), (0, 0, 1)), js.Sphere((0.4, 0.6, 0.4), 0.35)
    whole, part = (js.slice(particles, plane, within=clip, **SIZE) for clip in (None, ball))
    inside = np.linalg.norm(part.positions() - (0.4, 0.6, 0.4), axis=-1) < 0.35
    assert np.isnan(part.values[~inside]).all() and np.isfinite(part.values[inside]).any()
    np.testing.assert_allclose(part.values[inside], whole.values[inside], atol=1e-5)


@pytest.mark.parametrize("box", [None, SIDES], ids=["free", "periodic"])
def test_a_plain_sum_is_that_of_samples_where_it_is_shown(box):
    particles, plane, ball = particles_of(box), js.Plane((0.5, 0.6, 0.4), (0.2, 0, 1)), js.Sphere((0.4, 0.6, 0.4), 0.6)
    masses = np.random.default_rng(3).uniform(1, 2, 150)
    found = js.slice(particles, plane, within=ball, view_height=1.8, of=masses, normalised=False, **SIZE)
    place = found.positions()
    shown = np.linalg.norm(place - (0.4, 0.6, 0.4), axis=-1) < 0.6
    shown &= (box is None) | ((place >= 0) & (place <= SIDES)).all(-1)
    np.testing.assert_array_equal(np.isfinite(found.values), shown)
    truth = js.sample(particles, place[shown], masses, False)
    np.testing.assert_allclose(found.values[shown], truth, rtol=1e-6, atol=1e-7 * truth.max())
    assert found.values.dtype == np.float32
    assert box is not None or 0 < (found.values[shown] == 0).mean() < 0.5


def test_values_of_their_own_are_sliced_as_a_quantity_is():
    particles, plane = particles_of(), js.Plane((0.5, 0.6, 0.4), (0, 0, 1))
    values = 1e12 * np.random.default_rng(3).normal(size=150)
    carried = dataclasses.replace(particles, quantity=np.pad(np.float32(values), (0, particles.capacity - 150)))
    found, expected = js.slice(particles, plane, of=values, **SIZE), js.slice(carried, plane, **SIZE)
    agree(found.values, expected.values, 1e-5 * np.ptp(values))


def test_a_slice_in_any_unit_of_length_has_the_same_values():
    particles, scale = particles_of(), 2.0**80
    lengths = {name: getattr(particles, name) * scale for name in ("position", "support")}
    planes = [js.Plane(np.array([0.5, 0.6, 0.4]) * size, (0, 0, 1)) for size in (1, scale)]
    found = js.slice(dataclasses.replace(particles, **lengths, position_rest=None), planes[1], **SIZE)
    agree(found.values, js.slice(particles, planes[0], **SIZE).values, 1e-4)


def test_far_from_the_origin_small_supports_have_the_same_values():
    rng, far = np.random.default_rng(5), np.array([3e5, -2e5, 1e5])
    position, support, quantity = rng.uniform(-0.5, 0.5, (2000, 3)), rng.uniform(0.05, 0.1, 2000), rng.normal(size=2000)
    near, off = (js.Particles.from_arrays(position + at, support, quantity) for at in (np.zeros(3), far))
    found, expected = (
        js.slice(one, js.Plane(at, (1, 2, 2)), center=at, view_height=1.0, **SIZE)
        for one, at in ((off, far), (near, np.zeros(3)))
    )
    agree(found.values, expected.values, 1e-5 * np.ptp(quantity))


def test_means_are_between_the_least_and_the_greatest_value():
    particles = particles_of(quantity=np.where(np.arange(150) % 9, 0.0, 1e6 / 3))
    values = js.slice(particles, js.Plane((0.5, 0.6, 0.4), (0, 0, 1)), **SIZE).values
    assert np.nanmin(values) == 0 and np.nanmax(values) <= np.float32(1e6 / 3)


def test_nothing_is_nothing():
    nobody = js.slice(js.Particles.from_arrays(np.zeros((0, 3)), 1.0, 1.0), js.Plane((0.5, 0.6, 0.4), (0, 0, 1)), **SIZE)
    assert np.isnan(nobody.values).all()


def test_a_picture_has_the_colours_of_the_values_and_black_elsewhere():
    values = np.array([[0.0, 0.5], [2.0, np.nan]], np.float32)
    camera = js.Camera.orthographic((0, 0, 0), (0, 0, 1), view_height=2.0, width=2, height=2, near=-1, far=1)
    look = js.TransferFunction.from_points([0, 1], [[0, 0, 0], [1, 0.5, 0]], [0, 0])  # extinction is not asked
    image = Slice(values, camera).image(look)
    np.testing.assert_allclose(image.color, [[[0, 0, 0], [0.5, 0.25, 0]], [[1, 0.5, 0], [0, 0, 0]]])
    np.testing.assert_array_equal(image.transmittance, [[0, 0], [0, 1]])


@pytest.mark.parametrize(
    ("normal", "right", "up"), [((0, 0, 1), "x", "y"), ((1, 0, 0), "y", "z"), ((0, -1, 0), "x", "z"), ((0, 0, 3), "x", "y")]
)
def test_a_slice_along_axes_has_them_to_the_right_and_upwards(normal, right, up):
    rise = {axis: np.diff(js.slice(particles_of(), js.Plane((0.5, 0.6, 0.4), normal), **SIZE).positions(), axis=k)
            for k, axis in ((1, "right"), (0, "up"))}  # fmt: skip
    assert (rise["right"][..., "xyz".index(right)] > 0).all() and (rise["up"][..., "xyz".index(up)] < 0).all()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"plane": (0, 0, 1)}, "`plane` must be a `jaxsph.Plane`, got .* of type tuple"),
        ({"center": (0, 0)}, "`center` must have shape"),
        ({"width": 0}, "`width`"),
        ({"view_height": -1.0}, "`view_height`"),
    ],
)
def test_bad_input_is_refused_by_name(given, said):
    with pytest.raises(ValueError, match=said):
        js.slice(particles_of(), **({"plane": js.Plane((0, 0, 0), (0, 0, 1))} | given))
