"""Profiles of points: what they are along a ray agrees with what they are at a place, and gradients are finite everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.model.points import Ball, Chord, Gaussian, Profile, Shaped, Table, profile_of

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
