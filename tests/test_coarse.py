"""What is seen as one is merged, what is not is left alone, and no pixel changes by more than its bound."""

import jax
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import jaxsph as js
from jaxsph.access.lists import ListPlan
from jaxsph.cast.batches import CastPlan

SETTINGS = js.Settings(samples=19)
COUNT, WIDTH, HEIGHT = 8, 12, 11
PLAN = js.Plan(WIDTH, HEIGHT, SETTINGS.samples, COUNT, 3, 1, ListPlan(1, 1, COUNT, 4 * COUNT), CastPlan(16, 4, 48), 0)


def camera(distance=4.0, fov=40.0, width=WIDTH, height=HEIGHT):
    size = {"width": width, "height": height, "near": distance - 2, "far": distance + 2}
    return js.Camera.look_at(np.array([0.0, 0, -distance]), np.zeros(3), fov_degrees=fov, **size)


def cluster(count=500, radius=0.01, spread=1.0, dtype=np.float32, **given):
    rng = np.random.default_rng(3)
    position = spread * rng.uniform(-1, 1, (count, 3)).astype(dtype)
    size = radius * rng.uniform(0.5, 1, count).astype(dtype)
    return js.Points.from_arrays(position, size, rng.random((count, 3)), opacity=0.1, **given)


def same(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


def content(points):
    """Integral of extinction over space but for a factor, of all and for each colour, in float64."""
    valid = np.asarray(points.valid)
    radius, extinction = (np.asarray(value, np.float64)[valid] for value in (points.radius, points.extinction))
    weight = extinction * radius**3
    return np.array([weight.sum(), *(weight[:, None] * np.asarray(points.color, np.float64)[valid]).sum(0)])


def test_a_camera_near_by_leaves_points_as_they_are_bit_for_bit():
    points = cluster()
    found = js.coarsened(points, camera(fov=0.05))
    assert same(found.part, points)
    assert not np.asarray(found.merged).any()


def test_far_away_points_are_merged_and_kept_in_fewer_entries():
    points = cluster()
    found = js.coarsened(points, camera(), 2.0)
    assert 1 < found.part.num_points < 250
    assert found.part.capacity < points.capacity
    assert np.asarray(found.merged).sum() > 10


def test_extinction_and_colour_over_space_are_kept():
    points = cluster()
    np.testing.assert_allclose(content(js.coarsened(points, camera(), 2.0).part), content(points), rtol=1e-5)


@pytest.mark.parametrize("profile", ["gaussian", "ball"])
def test_a_node_has_the_centroid_and_the_spread_of_its_points(profile):
    """The mean square of all coordinates, of points as of the one that stands for them, by quadrature over shells."""
    points = cluster(7, spread=0.01, profile=profile)
    coarse = js.coarsened(points, camera(), 2.0).part
    assert coarse.num_points == 1
    q = (np.arange(4000) + 0.5) / 4000
    f = np.exp(-4.5 * q**2) if profile == "gaussian" else np.ones_like(q)
    moment = (f * q**4).sum() / (f * q**2).sum()

    def spread(points, about):
        valid = np.asarray(points.valid)
        place, radius, extinction = (
            np.asarray(v, np.float64)[valid] for v in (points.position, points.radius, points.extinction)
        )
        weight = extinction * radius**3 / (extinction * radius**3).sum()
        middle = (weight[:, None] * place).sum(0)
        return middle, (weight * (((place - about) ** 2).sum(1) + moment * radius**2)).sum()

    middle, _ = spread(points, 0)
    np.testing.assert_allclose(np.asarray(coarse.position)[np.asarray(coarse.valid)][0], middle, atol=1e-8)
    assert spread(coarse, middle)[1] == pytest.approx(spread(points, middle)[1], rel=1e-5)


def test_under_jit_entries_are_as_many_as_before_and_hold_the_same():
    points, view = cluster(), camera()
    eager, jitted = js.coarsened(points, view, 2.0), jax.jit(js.coarsened)(points, view, 2.0)
    assert jitted.part.capacity == points.capacity
    valid, kept = np.asarray(jitted.part.valid), np.asarray(eager.part.valid)
    assert valid.sum() == kept.sum()
    for name in ("position", "radius", "color", "extinction"):
        one, other = np.asarray(getattr(jitted.part, name))[valid], np.asarray(getattr(eager.part, name))[kept]
        np.testing.assert_array_equal(one, other)


def test_points_in_one_place_are_one_point_of_all_their_extinction():
    points = js.Points.from_arrays(np.zeros((9, 3), np.float32), np.float32(1e-16), extinction=1.0)
    coarse = js.coarsened(points, camera()).part
    assert coarse.num_points == 1
    np.testing.assert_allclose([coarse.radius[0], coarse.extinction[0]], [1e-16, 9], rtol=1e-6)


def test_points_of_no_extinction_are_merged_too():
    points = js.Points.from_arrays(np.float32([[0, 0, 0], [0.01, 0, 0]]), 1e-3, extinction=0.0)
    coarse = js.coarsened(points, camera()).part
    assert coarse.num_points == 1
    np.testing.assert_allclose(coarse.position[0], [0.005, 0, 0], atol=1e-8)
    assert float(coarse.extinction[0]) == 0


def test_no_points_stay_none():
    found = js.coarsened(js.Points.from_arrays(np.zeros((0, 3)), 1.0, extinction=1.0), camera())
    assert found.part.num_points == 0
    np.testing.assert_array_equal(js.render(js.Scene(points=found.part), camera(), SETTINGS).alpha, 0)


def test_float64_positions_far_from_the_origin_keep_their_centroid():
    position = np.array([[1e6, 0, 0], [1e6 + 0.03, 0, 0]])
    view = js.Camera.look_at(np.array([1e6, 0, -4.0]), np.array([1e6, 0, 0]), width=WIDTH, height=HEIGHT, near=2, far=6)
    coarse = js.coarsened(js.Points.from_arrays(position, 1e-3, extinction=1.0), view).part
    assert coarse.num_points == 1
    np.testing.assert_allclose(coarse.exact_position()[0], [1e6 + 0.015, 0, 0], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_thickness_of_the_image_is_kept_where_points_are_smaller_than_pixels():
    """Between the means over an image of 16 rays a pixel, of points before and after."""
    points = cluster(2000, radius=0.05)
    coarse = js.coarsened(points, camera(), 1.0).part
    assert coarse.num_points < 1800
    rays = camera(width=16 * WIDTH, height=16 * HEIGHT)
    given = {"settings": js.Settings(samples=19)}
    thickness = [
        -np.log(np.asarray(js.render(js.Scene(points=one), rays, **given).transmittance, np.float64)).mean()
        for one in (points, coarse)
    ]
    assert thickness[1] == pytest.approx(thickness[0], rel=0.01)


def numbers(*shape):
    return hnp.arrays(np.float64, shape, elements=st.floats(0, 1, width=32), fill=st.nothing())


@settings(max_examples=40, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(numbers(COUNT, 3), numbers(COUNT), numbers(COUNT, 3), st.sampled_from([0.01, 0.1, 1.0]), st.sampled_from([1.0, 4.0, 40.0]))
def test_no_pixel_changes_by_more_than_its_bound(place, size, color, scale, pixels):
    with jax.enable_x64(True):
        extinction = np.resize([0.1, 3.0, 1e3], COUNT) / scale
        position, radius = scale * (2 * place - 1), scale * (0.02 + 0.3 * size)
        points = js.Points.from_arrays(position, radius, color, extinction, capacity=COUNT)
        view = camera()
        found = jax.jit(js.coarsened)(points, view, pixels)
        before, after = (js.render(js.Scene(points=one), view, SETTINGS, plan=PLAN) for one in (points, found.part))
        bound = np.asarray(js.coarse_bound(found, view, SETTINGS, plan=PLAN))
        for layer in ("color", "alpha"):
            difference = np.abs(np.asarray(getattr(before, layer)) - np.asarray(getattr(after, layer)))
            assert (difference.reshape(HEIGHT, WIDTH, -1).max(-1) <= bound).all()


def test_particles_keep_volume_and_quantity_and_cover_what_they_stand_for():
    rng = np.random.default_rng(0)
    position = rng.uniform(-1, 1, (400, 3)).astype(np.float32)
    particles = js.Particles.from_arrays(position, np.float32(0.02), rng.random(400), rng.uniform(0.5, 1, 400))
    found = js.coarsened(particles, camera(), 4.0)
    before, after = particles.to_numpy(), found.part.to_numpy()
    assert len(after["volume"]) < 200
    assert after["volume"].sum() == pytest.approx(before["volume"].sum(), rel=1e-5)
    total = (before["volume"] * before["quantity"]).sum()
    assert (after["volume"] * after["quantity"]).sum() == pytest.approx(total, rel=1e-5)
    gaps = np.linalg.norm(before["position"][:, None] - after["position"], axis=-1) + before["support"][:, None]
    assert (gaps <= after["support"] * (1 + 1e-6)).any(1).all()


@pytest.mark.parametrize(
    ("part", "pixels", "message"),
    [
        (cluster(3), 0.0, "`pixels` must be > 0"),
        (cluster(3, spread=1.0), np.nan, "`pixels` must be > 0"),
        (
            js.Points.from_arrays(np.zeros((1, 3)), 1.0, extinction=1.0, profile=lambda at, _: at[0] ** 2),
            1.0,
            "`profile` must be radial",
        ),
        (np.zeros(3), 1.0, "`part` must be .* got ndarray"),
    ],
)
def test_what_cannot_be_merged_is_refused(part, pixels, message):
    with pytest.raises(ValueError, match=message):
        js.coarsened(part, camera(), pixels)


def test_nothing_bounds_merged_particles():
    particles = js.Particles.from_arrays(np.zeros((2, 3)), 0.1, 0.0)
    with pytest.raises(ValueError, match="nothing bounds merged particles"):
        js.coarse_bound(js.coarsened(particles, camera()), camera())
