"""Domains: where control points sit; and scales: axes on which they are spread evenly."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.model.transfer.maps import DOMAINS, Scale

QUANTITY = np.random.default_rng(3).lognormal(0, 2, 4000)
exponents = st.floats(-12, 12)


@pytest.mark.parametrize("domain", DOMAINS)
@pytest.mark.parametrize("points", [2, 16, 33])
def test_control_values_ascend_and_are_as_many_as_asked(domain, points):
    values = js.TransferFunction.control_values(domain, QUANTITY, points=points)
    assert values.shape == (points,) and (np.diff(values) > 0).all()


@pytest.mark.parametrize("domain", ["linear", "log", "symlog", "equalised"])
def test_ends_that_are_given_are_kept_exactly(domain):
    values = js.TransferFunction.control_values(domain, np.concatenate([QUANTITY, [0.1, 30.0]]), low=0.1, high=30.0)
    assert values[[0, -1]].tolist() == [0.1, 30.0]


@given(exponents, exponents)
def test_control_values_of_a_log_domain_have_even_logarithms(low, high):
    assume(high - low > 0.1)
    values = js.TransferFunction.control_values("log", low=10.0**low, high=10.0**high)
    np.testing.assert_allclose(np.log10(values), np.linspace(low, high, 16), rtol=0, atol=1e-12)


@given(st.floats(1e-3, 1e6))
def test_a_symlog_domain_is_odd_about_zero_linear_within_its_width_and_logarithmic_far_beyond(high):
    values = js.TransferFunction.control_values("symlog", low=-high, high=high, points=33)
    np.testing.assert_allclose(values, -values[::-1], rtol=0, atol=1e-12 * high)
    np.testing.assert_allclose(values[-1] / values[-2], values[-2] / values[-3], rtol=1e-2)


def test_an_equalised_domain_gives_every_colour_to_as_many_particles():
    values = js.TransferFunction.control_values("equalised", QUANTITY, points=11)
    counts = np.histogram(QUANTITY, values)[0]
    assert np.abs(counts - len(QUANTITY) / 10).max() <= 1


def test_an_equalised_domain_counts_by_weight():
    weights = np.where(QUANTITY > 1, 9.0, 1.0)
    values = js.TransferFunction.control_values("equalised", QUANTITY, weights=weights, points=11)
    share = np.histogram(QUANTITY, values, weights=weights)[0] / weights.sum()
    np.testing.assert_allclose(share, 0.1, atol=2 * 9 / weights.sum())


def test_values_that_many_share_take_no_more_than_one_colour():
    values = js.TransferFunction.control_values("equalised", [*np.zeros(1000), 1.0, 2.0, 3.0], points=4)
    np.testing.assert_allclose(values, [0, 1, 2, 3])


def test_percentages_are_of_the_quantity():
    values = js.TransferFunction.control_values("percentile", QUANTITY, low=10, high=90)
    np.testing.assert_allclose(values[[0, -1]], np.percentile(QUANTITY, [10, 90]))
    np.testing.assert_allclose(np.diff(values, 2), 0, atol=1e-12)


@pytest.mark.parametrize("domain", ["linear", "symlog", "percentile", "equalised"])
def test_a_constant_quantity_has_a_range_around_it(domain):
    values = js.TransferFunction.control_values(domain, np.full(20, -4.0))
    assert values[0] < -4 < values[-1]


def test_what_is_not_finite_is_not_counted():
    odd = np.concatenate([QUANTITY, [np.nan, np.inf, -np.inf]])
    for domain in DOMAINS:
        np.testing.assert_array_equal(
            js.TransferFunction.control_values(domain, odd), js.TransferFunction.control_values(domain, QUANTITY)
        )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"norm": "loglog"}, "linear, log, symlog, percentile, equalised"),
        ({"norm": "log", "low": 0.0, "high": 1.0}, "symlog"),
        ({"norm": "log", "quantity": QUANTITY, "low": -1.0}, f"{QUANTITY.min():.4g}"),
        ({"norm": "log", "quantity": -QUANTITY}, "has none"),
        (
            {"norm": "log", "quantity": [0.0, 0.0, 1.0, -2.0]},
            "only positive value .* 3 of 4 are not positive.* 'symlog'",
        ),
        ({"norm": "linear", "low": 1.0}, "`high`"),
        ({"norm": "linear", "low": 2.0, "high": 1.0}, "ascend"),
        ({"norm": "percentile", "quantity": QUANTITY, "high": 101.0}, "percentages"),
        ({"norm": "equalised"}, "`quantity`"),
        ({"norm": "equalised", "quantity": QUANTITY, "low": -2.0, "high": -1.0}, "widen"),
        ({"norm": "symlog", "low": -1.0, "high": 1.0, "width": 0.0}, "`width`"),
        ({"norm": "linear", "low": 0.0, "high": 1.0, "width": 1.0}, "leave it out"),
        ({"norm": "linear", "low": 0.0, "high": 1.0, "points": 1}, "two ends"),
        ({"norm": "equalised", "quantity": QUANTITY, "weights": [1.0]}, "`weights`"),
    ],
)
def test_what_makes_no_domain_is_refused_with_a_remedy(given, said):
    with pytest.raises(ValueError, match=said):
        js.TransferFunction.control_values(**given)


@pytest.mark.parametrize(
    ("domain", "name"),
    [("linear", "linear"), ("percentile", "linear"), ("log", "log"), ("symlog", "even"), ("equalised", "even")],
)
@pytest.mark.parametrize("points", [16, 64])
def test_control_values_of_every_domain_are_even_on_their_scale_also_in_float32(domain, name, points):
    values = js.TransferFunction.control_values(domain, QUANTITY, points=points).astype(np.float32)
    scale = Scale.of(values)
    assert scale.name == name
    np.testing.assert_allclose(scale.place(values), np.linspace(0, 1, points), atol=2e-5)


@pytest.mark.parametrize("values", [[-3.0, 1.0, 5.0], [1e-4, 1e-2, 1.0], np.cumsum(np.arange(1.0, 12))])
def test_places_and_values_are_inverse(values):
    scale, place = Scale.of(np.array(values)), np.linspace(0, 1, 77)
    np.testing.assert_allclose(scale.place(scale.value(place)), place, atol=1e-12)


def test_points_laid_by_hand_and_jumps_have_a_linear_axis():
    assert Scale.of(np.array([0.0, 0.1, 0.9, 1.0])).name == "linear"
    assert Scale.of(np.array([0.0, 1, 1, 2, 4, 8, 16, 32, 64])).name == "linear"


@pytest.mark.parametrize("values", [[3.0], [0.0, 0.0], [-1e9]])
def test_a_single_value_has_an_axis_around_it(values):
    scale = Scale.of(np.array(values))
    assert scale.name == "linear" and 0 < scale.place(values[0]) < 1


def test_what_is_not_positive_is_below_a_logarithmic_axis():
    assert Scale.of(np.geomspace(1, 100, 16)).place(np.array([0.0, -1.0])).tolist() == [-np.inf, -np.inf]
