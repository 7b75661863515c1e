"""Particles between two snapshots: the same ones by their ids, in any order, against a loop over ids."""

import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st

from jaxsph.io.settle.matching import Matched, agree, between, ids_of, match
from jaxsph.io.table import ParticleTable


def snapshot(rng, ids):
    count = len(ids)
    return {
        "position": rng.normal(size=(count, 3)),
        "support": rng.uniform(0.1, 2, count),
        "volume": rng.uniform(0.1, 2, count),
        "quantity": rng.normal(size=count),
    }


@examples(40)
@given(st.integers(0, 1000), st.floats(0.01, 0.99))
def test_every_particle_is_where_its_own_two_places_lead(seed, share):
    rng = np.random.default_rng(seed)
    ids = [rng.permutation(40)[: rng.integers(30, 40)] for _ in range(2)]
    first, second = (snapshot(rng, one) for one in ids)
    found = between(first, second, match(*ids), share)
    expected = []
    for one in range(40):
        at = [np.flatnonzero(each == one) for each in ids]
        if len(at[0]) and len(at[1]):
            place = (1 - share) * first["position"][at[0][0]] + share * second["position"][at[1][0]]
        elif len(at[int(share >= 0.5)]):
            place = (first, second)[int(share >= 0.5)]["position"][at[int(share >= 0.5)][0]]
        else:
            continue
        expected.append(place)
    apart = np.abs(found["position"][:, None] - np.array(expected)).max(-1)
    assert apart.shape[0] == apart.shape[1] and max(apart.min(0).max(), apart.min(1).max()) <= 1e-12
    assert all(len(column) == len(expected) for column in found.values())


def test_supports_change_by_factors_and_quantities_evenly():
    one = {"position": np.zeros((1, 3)), "support": np.array([1.0]), "volume": np.array([0.0]), "quantity": np.array([0.0])}
    other = {"position": np.ones((1, 3)), "support": np.array([4.0]), "volume": np.array([2.0]), "quantity": np.array([8.0])}
    found = between(one, other, match(np.array([7]), np.array([7])), 0.5)
    assert (found["support"][0], found["volume"][0], found["quantity"][0]) == (pytest.approx(2), 1, 4)


def test_a_periodic_box_is_crossed_on_the_shortest_way():
    one = {"position": np.array([[9.0, 5, 0.5]])}
    other = {"position": np.array([[1.0, 5, 9.5]])}
    found = between(one, other, match(np.array([1]), np.array([1])), 0.75, (10.0, 10.0, 10.0))
    np.testing.assert_allclose(found["position"], [[0.5, 5, 9.75]])


def test_with_velocities_a_fall_is_a_parabola():
    times, fall = np.array([1.0, 3.0]), lambda t: np.array([[2 * t, 10 - 4.9 * t**2, 0]])
    speed = lambda t: np.array([[2, -9.8 * t, 0]])  # noqa: E731
    run = tuple(np.diff(times)[0] * speed(t) for t in times)
    ends = [{"position": fall(t)} for t in times]
    matched = Matched(*np.zeros((2, 1), int), *np.zeros((2, 0), int))
    for share in (0.2, 0.5, 0.9):
        found = between(*ends, matched, share, None, run)
        np.testing.assert_allclose(found["position"], fall(1 + 2 * share), rtol=1e-12)


def test_velocities_are_of_use_only_where_they_lead_to_where_particles_are():
    way = np.random.default_rng(0).normal(size=(50, 3))
    assert agree(way, (way, way)) and agree(way, (0 * way, 2 * way))
    assert not agree(way, (100 * way, 100 * way)) and not agree(way, (0.01 * way, 0.01 * way)) and not agree(way, (-way, -way))


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({}, "no ids"),
        ({"id": np.array([0.5, 1, 2])}, "no whole numbers"),
        ({"ParticleIDs": np.array([1, 1, 2])}, "same `ParticleIDs`"),
    ],
)
def test_ids_that_tell_nothing_are_told_of(columns, said):
    found = ids_of(ParticleTable(np.zeros((3, 3)), columns))
    assert said in found and match(found, np.arange(3)) == found


def test_ids_that_hardly_match_are_not_taken_for_names():
    assert "only 1 ids of 10 and 10" in match(np.arange(10), np.arange(9, 19))
    assert isinstance(match(np.arange(10), np.arange(4, 14)), Matched)
