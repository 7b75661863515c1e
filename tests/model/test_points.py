"""Points are checked when they are made; their profiles are one along rays and at places, with gradients that are finite."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.model.points import Ball, Chord, Gaussian, Profile, Shaped, Table, profile_of

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
        ({"extinction": None, "opacity": 0.5, "profile": [0.0, 0.0]}, "`profile` is 0 along a ray through the centre"),
        ({"extinction": None, "opacity": 0.5, "profile": jnp.add}, "give `extinction`, not `opacity`"),
        ({"extinction": None, "opacity": 1 - 1e-12, "radius": 1e-38}, "`extinction` must be finite, .*overflows float32"),
        ({"profile": [1.0]}, "at least 2 numbers, got 1"),
        ({"spread": "feat"}, "`spread` must be one of 'chords', 'feet', 'centres', got 'feat'"),
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


TABLE = (1.0, 0.8, 0.9, 0.1, 0.0)
PROFILES = {"gaussian": Gaussian(), "ball": Ball(), "table": profile_of(TABLE, jnp.float32)}
OF_DISTANCE = {
    "gaussian": lambda q: np.exp(-4.5 * q**2),
    "ball": np.ones_like,
    "table": lambda q: np.interp(q, np.linspace(0, 1, len(TABLE)), TABLE),
}
parts = st.floats(0, 1, width=32)


def measured(profiles, square, start, end):
    """Along rays, at distances and through the centre, and by the rule that profiles have by default."""
    with_rule = {"by the rule": Profile.along(Gaussian(), square, start, end)}
    return with_rule | {
        name: (profile.along(square, start, end), profile.at_square(square), profile.through_centre())
        for name, profile in profiles.items()
    }


def added(profiles, *ends):
    return sum(profile.along(*ends) + profile.at_square(ends[0]) for profile in profiles.values())


looked, slopes_of = jax.jit(measured), jax.jit(jax.grad(added, (0, 1, 2, 3)))


def of(name, *ends):
    return looked(PROFILES, *map(np.float32, ends))[name]


def integral(name, square, start, end):
    """By the midpoint rule in float64."""
    count = 20_000
    t = start + (end - start) * (np.arange(count) + 0.5) / count
    return (end - start) * OF_DISTANCE[name](np.sqrt(square + t**2)).mean()


@pytest.mark.parametrize("name", PROFILES)
@given(parts, parts, parts)
@examples(25)
def test_integrals_along_rays_are_those_of_the_profile(name, b, low, high):
    """A table's kinks are not met by nodes: within 2 % of its largest number."""
    half = np.sqrt(1 - b**2)
    start, end = sorted((half * (2 * low - 1), half * (2 * high - 1)))
    error = abs(float(of(name, np.float32(b) ** 2, start, end)[0]) - integral(name, np.float64(b) ** 2, start, end))
    assert error <= (0.02 if name == "table" else 1e-6)


@pytest.mark.parametrize("name", PROFILES)
def test_through_the_centre_it_is_the_integral_along_a_whole_ray(name):
    np.testing.assert_allclose(of(name, 0, -1, 1)[2], integral(name, 0.0, -1.0, 1.0), rtol=1e-6)


@pytest.mark.parametrize("name", PROFILES)
@given(parts)
@examples(25)
def test_at_a_distance_it_is_what_its_definition_says(name, q):
    np.testing.assert_allclose(of(name, np.float32(q) ** 2, 0, 0)[1], OF_DISTANCE[name](np.float64(q)), atol=1e-5)


def test_quadrature_meets_smooth_profiles_closely():
    """The rule that profiles have by default, for that which has a closed form."""
    for b in (0.0, 0.3, 0.9):
        half = np.sqrt(1 - b**2)
        ends = b**2, -half, half
        np.testing.assert_allclose(of("by the rule", *ends), of("gaussian", *ends)[0], rtol=2e-6)


def test_a_cusp_at_the_centre_is_met():
    decay = profile_of(np.exp(-5 * np.linspace(0, 1, 33)), jnp.float32)
    shaped = profile_of(lambda offset, _: jnp.exp(-5 * jnp.sqrt(sum(part**2 for part in offset))), jnp.float32)

    @jax.jit
    def along(x, y):
        chord = Chord((x, x, x), (x, y, x), {})
        return decay.through_centre(), decay.along(x, -y, y), shaped.along_chord(chord, -y, y)

    exact, whole, got = along(np.float32(0), np.float32(1))
    np.testing.assert_allclose(whole, exact, rtol=1e-3)
    np.testing.assert_allclose(got, 2 * (1 - np.exp(-5)) / 5, rtol=1e-3)


@pytest.mark.parametrize(("square", "start", "end"), [(0.0, -1.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.25, 0.1, 0.1)])
def test_gradients_are_finite_at_the_centre_at_the_rim_and_of_no_length(square, start, end):
    slopes = slopes_of(PROFILES, *map(np.float32, (square, start, end)))
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))


def test_a_table_is_differentiated_by_its_numbers():
    slopes = jax.jit(jax.grad(lambda values: Table(values).through_centre()))(np.float32(TABLE))
    np.testing.assert_allclose(slopes, [0.25, 0.5, 0.5, 0.5, 0.25])


def test_a_function_is_asked_at_offsets_along_the_ray_with_attributes():
    shaped = profile_of(lambda offset, attributes: attributes["age"] * (offset[0] + 2 * offset[1] ** 2), jnp.float32)
    foot, direction = (0.1, 0.2, 0.3), (0.6, 0.0, 0.8)
    chord = Chord(*(tuple(map(np.float32, part)) for part in (foot, direction)), {"age": np.float32(3.0)})
    got = jax.jit(shaped.along_chord)(chord, np.float32([-0.5, 0.0]), np.float32([0.25, 0.5]))
    t = np.array([[-0.5, 0.25], [0.0, 0.5]])
    expected = 3 * ((0.1 + 2 * 0.2**2) * np.diff(t)[:, 0] + 0.3 * np.diff(t**2)[:, 0])
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    with pytest.raises(ValueError, match="give `extinction`, not `opacity`"):
        jax.eval_shape(shaped.through_centre)


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ("gauss", "`profile` must be 'gaussian', 'ball', a table of numbers or a function of the offset, got 'gauss'"),
        ([1.0], "`profile` must be a table of at least 2 numbers, got 1"),
        (1.0, r"`profile` must have shape \(N,\), got \(\)"),
        ([[1.0, 0.0]], r"`profile` must have shape \(N,\), got \(1, 2\)"),
        ([1.0, -0.5], r"`profile` must be >= 0, but profile\[1\] = -0.5; extinction cannot be negative"),
        ([1.0, np.nan], r"`profile` must be finite, .* first profile\[1\] = nan"),
        ([1.0, 1e300], "`profile` must be finite, .*overflows float32"),
        (["a", "b"], "`profile` must hold real numbers"),
        (None, "`profile` must hold real numbers, got dtype object"),
    ],
)
def test_what_is_no_profile_is_refused_by_name(wrong, match):
    with pytest.raises(ValueError, match=match):
        profile_of(wrong, jnp.float32)


def test_profiles_are_kept_and_are_a_part_of_what_is_compiled():
    table = profile_of(TABLE, jnp.float32)
    assert profile_of(table, jnp.float32) is table and profile_of("ball", jnp.float32) == Ball()
    assert len(jax.tree.leaves(table)) == 1 and not jax.tree.leaves([Gaussian(), Ball(), Shaped(np.sum)])
    assert jax.tree.structure(Shaped(np.sum)) == jax.tree.structure(Shaped(np.sum)) != jax.tree.structure(Shaped(np.max))


def test_float64_is_met_in_float64(x64):
    values = jax.jit(Gaussian().along)(*np.float64([0.04, -0.5, 0.7]))
    assert values.dtype == jnp.float64
    assert float(values) == pytest.approx(integral("gaussian", 0.04, -0.5, 0.7), rel=1e-8)
    assert profile_of(TABLE, jnp.float64).values.dtype == jnp.float64
