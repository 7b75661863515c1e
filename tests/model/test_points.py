"""Points are checked when they are made: what cannot be one is refused by name, and numbers stay what they are."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js

PLACES = np.arange(9, dtype=np.float32).reshape(3, 3)
SOUND = {"position": PLACES, "radius": 0.5, "color": (1.0, 0.5, 0.0), "extinction": 2.0}
CONE = (1.0, 0.0)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"position": PLACES[:, :2]}, r"`position` must have shape \(N, 3\), got \(3, 2\)"),
        ({"position": PLACES * np.nan}, r"`position` must be finite, .* first position\[0, 0\] = nan"),
        ({"position": PLACES.astype(complex)}, "`position` must hold real numbers, got dtype complex"),
        ({"position": np.full((1, 3), 1e300)}, "`position` must be finite, .*overflows float32"),
        ({"radius": 0.0}, r"`radius` must be > 0, but radius\[0\] = 0.0; give the radius of every point"),
        ({"radius": [1.0, np.nan, 1.0]}, r"`radius` must be finite, .* first radius\[1\] = nan"),
        ({"radius": [1.0, 1.0, -2.0]}, r"`radius` must be > 0, but radius\[2\] = -2.0"),
        ({"radius": [1.0, 1.0]}, r"`radius` must have shape \(3,\), got \(2,\); one value for each of the 3 points"),
        ({"radius": 1e-60}, "`radius` must be > 0, .*underflows float32"),
        ({"radius": None}, "`radius` must hold real numbers"),
        ({"color": (1.0, 2.0, 0.0)}, r"`color` must be in \[0, 1\], got 0 .. 2"),
        ({"color": (-0.1, 0.0, 0.0)}, r"`color` must be in \[0, 1\], got -0.1 .. 0"),
        ({"color": np.ones((3, 4))}, r"`color` must have shape \(3, 3\), got \(3, 4\); one row for each"),
        ({"color": 0.5}, r"`color` must have shape \(3, 3\), got \(\)"),
        ({"extinction": -1.0}, r"`extinction` must be >= 0, but extinction\[0\] = -1.0"),
        ({"extinction": np.inf}, "`extinction` must be finite"),
        ({"extinction": None}, "one of `extinction` and `opacity` must be given, got neither"),
        ({"opacity": 0.5}, "one of `extinction` and `opacity` must be given, got both"),
        ({"extinction": None, "opacity": 1.0}, r"`opacity` must be in \[0, 1\), got 1 .. 1"),
        ({"extinction": None, "opacity": -0.1}, r"`opacity` must be >= 0, but opacity\[0\] = -0.1"),
        (
            {"extinction": None, "opacity": 0.5, "profile": [0.0, 0.0]},
            "`profile` is 0 along a ray through the centre",
        ),
        ({"extinction": None, "opacity": 0.5, "profile": jnp.add}, "give `extinction`, not `opacity`"),
        ({"extinction": None, "opacity": 1 - 1e-12, "radius": 1e-38}, "`extinction` must be finite, .*overflows float32"),
        ({"profile": "gauss"}, "`profile` must be 'gaussian', 'ball'"),
        ({"profile": [1.0]}, "at least 2 numbers, got 1"),
        ({"profile": [1.0, -1.0]}, "`profile` must be >= 0"),
        ({"spread": "feet"}, "`spread` must be one of 'chords', 'centres', got 'feet'"),
        ({"splats_beyond": -1.0}, "`splats_beyond` must be >= 0 or None, got -1.0"),
        ({"splats_beyond": np.nan}, "`splats_beyond` must be >= 0 or None, got nan"),
        ({"capacity": 2}, r"`capacity` must be at least the number of points \(3\) and 1, got 2"),
        ({"attributes": {"age": [1.0]}}, r"`age` must have shape \(3,\), got \(1,\)"),
        ({"attributes": {"age": np.nan}}, "`age` must be finite"),
        ({"attributes": {"radius": 2.0}}, "`attributes` must not be named as what every point has, got 'radius'"),
    ],
)
def test_what_is_no_point_is_refused_by_name(changed, match):
    with pytest.raises(ValueError, match=match):
        js.Points.from_arrays(**SOUND | changed)


def test_a_point_without_radius_is_no_point():
    with pytest.raises(TypeError, match="radius"):
        js.Points.from_arrays(PLACES, extinction=1.0)


def test_numbers_stay_what_they_are_and_padding_repeats_the_first_point():
    points = js.Points.from_arrays(**SOUND | {"radius": [1.0, 2.0, 3.0]}, attributes={"age": [5.0, 6.0, 7.0]}, capacity=5)
    assert (points.capacity, points.num_points, points.dtype) == (5, 3, np.float32)
    np.testing.assert_array_equal(points.valid, [True, True, True, False, False])
    np.testing.assert_array_equal(points.position, [*PLACES, PLACES[0], PLACES[0]])
    np.testing.assert_array_equal(points.radius, [1, 2, 3, 1, 1])
    np.testing.assert_array_equal(points.color, [SOUND["color"]] * 5)
    np.testing.assert_array_equal(points.attributes["age"], [5, 6, 7, 5, 5])
    np.testing.assert_array_equal(points.bounds(), [(PLACES - [[1], [2], [3]]).min(0), (PLACES + [[1], [2], [3]]).max(0)])


def test_sets_of_similar_size_share_programs():
    count = {js.Points.from_arrays(np.zeros((number, 3)), 1.0, extinction=1.0).capacity for number in (33, 38, 40)}
    assert len(count) == 1


def test_no_points_are_an_empty_set():
    for nothing in ([], np.zeros((0, 3))):
        points = js.Points.from_arrays(nothing, 1.0, opacity=0.5)
        assert (points.num_points, points.capacity) == (0, 1) and not np.isnan(np.asarray(points.extinction)).any()
        np.testing.assert_array_equal(points.bounds(), np.zeros((2, 3)))


def test_what_float32_cannot_hold_of_a_place_is_kept():
    place = 1e6 + np.array([[1 / 3, 0.1, 0.7]])
    near = js.Points.from_arrays(place, 0.01, extinction=1.0, capacity=3)
    np.testing.assert_allclose(near.exact_position(), np.repeat(place, 3, 0), atol=1e-9)
    assert js.Points.from_arrays(PLACES.astype(np.float64), 0.01, extinction=1.0).position_rest is None


def test_float64_is_kept_where_it_is_enabled(x64):
    points = js.Points.from_arrays(PLACES.astype(np.float64), 0.1, opacity=0.5, profile=CONE)
    parts = (points.position, points.radius, points.color, points.extinction, points.profile.values)
    assert {part.dtype for part in parts} == {jnp.dtype("float64")} and points.position_rest is None


@pytest.mark.parametrize(("profile", "mean"), [("gaussian", 0.4166435), ("ball", 1.0), (CONE, 0.5)])
@given(st.floats(1e-6, 0.999999), st.floats(1e-3, 1e3))
@examples(20)
def test_a_ray_through_the_centre_has_the_opacity_that_was_asked_for(profile, mean, opacity, radius):
    """`mean` of the profile along the diameter; of the Gaussian by erf(sqrt(4.5)) sqrt(pi / 4.5) / 2."""
    points = js.Points.from_arrays(np.zeros((1, 3)), radius, opacity=opacity, profile=profile, capacity=1)
    thickness = np.float64(points.extinction).item() * np.float64(points.radius).item() * 2 * mean
    np.testing.assert_allclose(-np.expm1(-thickness), opacity, rtol=2e-5)


def test_an_opacity_that_float32_would_round_to_one_is_finite():
    points = js.Points.from_arrays(np.zeros((1, 3)), 1.0, opacity=1 - 1e-12)
    assert 20 < np.asarray(points.extinction)[0] < 40


def test_they_are_made_and_changed_under_jit():
    @jax.jit
    def moved(position, radius, opacity):
        points = js.Points.from_arrays(position, radius, opacity=opacity, splats_beyond=radius[0])
        return dataclasses.replace(points, radius=2 * points.radius)

    points = moved(PLACES, np.ones(3, np.float32), np.float32(0.5))
    assert points.num_points == 3 and points.position_rest is None and points.spread == "chords"
    np.testing.assert_array_equal(points.radius, np.full(points.capacity, 2))
    np.testing.assert_allclose(
        points.extinction, js.Points.from_arrays(PLACES, 1.0, opacity=0.5, capacity=points.capacity).extinction, rtol=1e-6
    )


def test_extinction_is_differentiable_by_opacity_and_radius():
    def extinction(opacity, radius):
        return js.Points.from_arrays(np.zeros((1, 3), np.float32), radius, opacity=opacity).extinction[0]

    by_opacity, by_radius = jax.jit(jax.grad(extinction, (0, 1)))(np.float32(0.5), np.float32(2))
    through = 0.833287
    np.testing.assert_allclose(by_opacity, 1 / (0.5 * 2 * through), rtol=1e-4)
    np.testing.assert_allclose(by_radius, -np.log(2) / (4 * through), rtol=1e-4)
