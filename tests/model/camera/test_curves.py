"""Curves through keys: continuous, at rest where keys are, monotone and ordered where they promise it."""

import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxsph.model.camera.leg import Turning, monotone, ordered, through

FEW = examples(25)
seeds = st.integers(0, 10_000)


def drawn(seed, keys=6):
    rng = np.random.default_rng(seed)
    return rng, np.cumsum(rng.uniform(0.2, 3, keys))


@FEW
@given(seeds)
def test_depths_stay_between_those_of_the_keys_and_near_stays_below_far(seed):
    rng, times = drawn(seed)
    near = rng.uniform(-3, 3, len(times))
    far = near + 10 ** rng.uniform(-4, 1, len(times))
    front, back = ordered(times, near, far)
    for k in range(len(times) - 1):
        at = np.linspace(times[k], times[k + 1], 101)
        for curve, keys in ((front, near), (back, far)):
            lo, hi = sorted((keys[k], keys[k + 1]))
            assert (curve(at) >= lo - 1e-12).all() and (curve(at) <= hi + 1e-12).all()
        assert (front(at) < back(at)).all()
    np.testing.assert_allclose(front(times), near, atol=1e-12)
    np.testing.assert_allclose(back(times), far, atol=1e-12)


@FEW
@given(seeds)
def test_a_monotone_curve_stays_between_its_keys(seed):
    rng, times = drawn(seed)
    values = rng.normal(size=len(times))
    curve = monotone(times, values)
    for k in range(len(times) - 1):
        found = curve(np.linspace(times[k], times[k + 1], 50))
        assert found.min() >= min(values[k : k + 2]) - 1e-12 and found.max() <= max(values[k : k + 2]) + 1e-12


@FEW
@given(seeds)
def test_places_and_rotations_are_met_and_their_speed_is_continuous(seed):
    rng, times = drawn(seed)
    keys = Rotation.from_rotvec(rng.normal(size=(len(times), 3)))
    places, turning = through(times, rng.normal(size=(len(times), 3))), Turning.through(times, keys)
    for k, time in enumerate(times):
        assert (turning(time).inv() * keys[k]).magnitude() < 1e-9
    small = 1e-7
    for time in times[1:-1]:
        before, after = turning(time - small).inv() * turning(time), turning(time).inv() * turning(time + small)
        np.testing.assert_allclose(before.as_rotvec() / small, after.as_rotvec() / small, atol=0.01)
        slopes = places(time) - places(time - small), places(time + small) - places(time)
        np.testing.assert_allclose(slopes[0] / small, slopes[1] / small, atol=0.01)


def test_what_stands_still_between_two_keys_stands_still():
    times = np.array([0.0, 1, 2, 3])
    places = through(times, np.array([[0.0, 0], [1, 2], [1, 2], [5, 5]]))
    turning = Turning.through(times, Rotation.from_rotvec([[0, 0, 0], [0, 1, 0], [0, 1, 0], [1, 1, 0]]))
    for time in np.linspace(1, 2, 11):
        np.testing.assert_allclose(places(time), [1, 2], atol=1e-14)
        np.testing.assert_allclose(turning(time).as_rotvec(), [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.2, 3, 1)])
def test_turning_evenly_about_one_axis_stays_even(spacing):
    times = np.cumsum((0, *spacing))
    axis = np.array([0.6, 0, 0.8])
    turning = Turning.through(times, Rotation.from_rotvec(0.7 * times[:, None] * axis))
    for time in np.linspace(0, times[-1], 23):
        assert (turning(time).inv() * Rotation.from_rotvec(0.7 * time * axis)).magnitude() < 1e-9


def test_two_rotations_are_joined_on_the_shortest_way():
    keys = Rotation.from_euler("y", [[10], [350]], degrees=True)
    found = Turning.through(np.array([0.0, 1]), keys)(0.5)
    assert found.magnitude() < 1e-9  # by 0 degrees, not by 180
