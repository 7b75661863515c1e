"""Scales: axes on which control points are spread evenly."""

import numpy as np
import pytest

from jaxsph.model.transfer.domains import Scale, control_values

QUANTITY = np.random.default_rng(3).lognormal(0, 2, 4000)


@pytest.mark.parametrize(
    ("domain", "name"),
    [("linear", "linear"), ("percentile", "linear"), ("log", "log"), ("symlog", "even"), ("equalised", "even")],
)
@pytest.mark.parametrize("points", [16, 64])
def test_control_values_of_every_domain_are_even_on_their_scale_also_in_float32(domain, name, points):
    values = control_values(domain, QUANTITY, points=points).astype(np.float32)
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
