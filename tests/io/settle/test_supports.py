import itertools

import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from jaxsph.io.settle import supports
from jaxsph.io.settle.supports import even_spacing, kernel_sum, nearest_neighbour_supports
from jaxsph.model.particles import kernels


def brute_force_sum(position, support, weight, kernel):
    distance = np.linalg.norm(position[:, None] - position[None], axis=-1) / support[:, None]
    chosen = kernels.by_name(kernel)
    return chosen.norm / support**3 * (chosen.of_square(distance**2, np) * weight).sum(axis=1)


def test_the_support_is_the_distance_to_the_kth_neighbour():
    position = np.random.default_rng(0).normal(size=(50, 3))
    distance = np.sort(np.linalg.norm(position[:, None] - position[None], axis=-1), axis=1)
    np.testing.assert_allclose(nearest_neighbour_supports(position, 8), distance[:, 8], rtol=1e-12)


def test_with_few_particles_the_support_scales_as_in_a_uniform_set():
    position = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    np.testing.assert_allclose(nearest_neighbour_supports(position, 16), np.array([3, 2, 3]) * 2.0)


SIDES = (1.0, 1.3, 0.7)


def replicated(position):
    """All 27 copies, those in the box first."""
    turns = sorted(itertools.product((-1, 0, 1), repeat=3), key=any)
    return np.concatenate([position + np.array(SIDES) * turn for turn in turns])


@given(st.integers(0, 2**31), st.integers(2, 60), st.integers(1, 40), st.booleans())
@examples(25)
def test_in_a_periodic_box_neighbours_are_found_as_among_explicit_copies(seed, count, neighbours, outside):
    rng = np.random.default_rng(seed)
    position = rng.uniform(0, 1, (count, 3)) * SIDES
    neighbours = min(neighbours, count - 1)
    apart = np.linalg.norm(position[:, None] - replicated(position).reshape(27, 1, count, 3), axis=-1).min(0)  # the nearest image
    given_position = position + outside * rng.integers(-2, 3, (count, 3)) * SIDES  # any period may be in a file
    found = nearest_neighbour_supports(given_position, neighbours, box=SIDES)
    np.testing.assert_allclose(found, np.sort(apart, 1)[:, neighbours], rtol=1e-9)


@pytest.mark.parametrize("kernel", list(kernels.KERNELS))
def test_in_a_periodic_box_kernel_sums_are_those_among_explicit_copies(kernel):
    rng = np.random.default_rng(4)
    position, support, weight = rng.uniform(0, 1, (50, 3)) * SIDES, rng.uniform(0.05, 0.35, 50), rng.random(50)
    truth = brute_force_sum(replicated(position), np.tile(support, 27), np.tile(weight, 27), kernel)[:50]
    np.testing.assert_allclose(kernel_sum(position, support, weight, kernel=kernel, box=SIDES), truth, rtol=1e-12)
    upon_faces = np.where(position < 0.1, 0.0, np.where(position > 0.6, SIDES, position))
    truth = brute_force_sum(replicated(upon_faces % SIDES), np.tile(support, 27), np.tile(weight, 27), kernel)[:50]
    np.testing.assert_allclose(kernel_sum(upon_faces, support, weight, kernel=kernel, box=SIDES), truth, rtol=1e-12)


def test_one_particle_or_none_has_a_support_too():
    np.testing.assert_array_equal(nearest_neighbour_supports(np.zeros((1, 3))), [1])
    assert nearest_neighbour_supports(np.zeros((0, 3))).shape == (0,)


@given(
    st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=1, max_size=40),
    st.integers(1, 5),
    st.sampled_from([1.0, 1e-6, 1e12]),
)
@examples(50)
def test_supports_are_positive_and_finite_however_particles_coincide(points, neighbours, unit):
    support = nearest_neighbour_supports(np.array(points) * unit, neighbours)
    assert np.isfinite(support).all() and (support > 0).all()


def test_fewer_than_one_neighbour_is_refused():
    refused("`neighbours` must be at least 1, got 0", nearest_neighbour_supports, np.zeros((2, 3)), 0)


@pytest.mark.parametrize("kernel", list(kernels.KERNELS))
def test_the_kernel_sum_is_the_gather_sum_with_each_particles_own_support(kernel, monkeypatch):
    monkeypatch.setattr(supports, "PAIR_BUDGET", 50)  # many blocks
    rng = np.random.default_rng(1)
    position, support, weight = rng.random((60, 3)), rng.uniform(0.05, 0.8, 60), rng.random(60)
    got = kernel_sum(position, support, weight, kernel=kernel)
    np.testing.assert_allclose(got, brute_force_sum(position, support, weight, kernel), rtol=1e-12)


def test_a_lonely_particle_has_the_volume_of_its_kernel():
    got = kernel_sum(np.zeros((1, 3)), np.array([2.0]))
    np.testing.assert_allclose(got, kernels.KERNELS["poly6"].norm / 8)


def test_the_kernel_sum_of_a_lattice_is_its_number_density():
    axis = np.arange(9.0)
    position = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    inside = (np.abs(position - 4) <= 1).all(axis=1)
    got = kernel_sum(position, np.full(len(position), 3.0), kernel="wendland_c2")[inside]
    np.testing.assert_allclose(got, 1, rtol=0.02)


def test_the_kernel_sum_of_nothing_is_nothing():
    assert kernel_sum(np.zeros((0, 3)), np.zeros(0)).shape == (0,)


def test_a_progress_bar_is_shown_when_asked_and_otherwise_not(capsys):
    position = np.random.default_rng(2).random((40, 3))
    nearest_neighbour_supports(position)
    assert capsys.readouterr().err == ""
    nearest_neighbour_supports(position, progress=True)
    assert "supports" in capsys.readouterr().err


@given(st.lists(st.tuples(*[st.integers(0, 2)] * 3), min_size=2, max_size=60), st.integers(1, 12), st.integers(1, 3))
@examples(50)
def test_coincident_particles_are_neighbours_and_sources_each_on_its_own(points, neighbours, num_supports):
    position = np.array(points, float)
    distance = np.sort(np.linalg.norm(position[:, None] - position[None], axis=-1), axis=1)
    reach = min(neighbours, len(position) - 1)
    expected = distance[:, reach] * (neighbours / reach) ** (1 / 3)
    apart = expected > 0
    np.testing.assert_allclose(nearest_neighbour_supports(position, neighbours)[apart], expected[apart], rtol=1e-12)
    support, weight = 0.7 + np.arange(len(position)) % num_supports, np.arange(1.0, len(position) + 1)
    got = kernel_sum(position, support, weight)
    np.testing.assert_allclose(got, brute_force_sum(position, support, weight, "poly6"), rtol=1e-12)


def test_where_many_particles_coincide_each_place_is_looked_at_once():
    position = np.repeat([[0.0, 0, 0], [3, 0, 0]], 50_000, axis=0)
    support = nearest_neighbour_supports(position)
    np.testing.assert_allclose(support, 3 * 32 ** (1 / 3))
    got = kernel_sum(position, np.full(100_000, 2.0))
    np.testing.assert_allclose(got, 50_000 * kernels.KERNELS["poly6"].norm / 8, rtol=1e-12)


def test_supports_that_reach_more_pairs_than_can_be_summed_are_refused(monkeypatch):
    monkeypatch.setattr(supports, "MAX_PAIRS", 10_000)
    position = np.random.default_rng(3).random((200, 3))
    with pytest.raises(ValueError, match=r"supports reach about 200 particles each, 40000 pairs.* give smaller supports"):
        kernel_sum(position, np.full(200, 2.0))
    assert (kernel_sum(position, np.full(200, 0.05)) > 0).all()


@given(st.floats(0, 0.2), st.floats(-6, 6), st.booleans())
def test_a_jittered_lattice_lies_evenly_whatever_its_spacing(jitter, decades, periodic):
    spacing, rng = 10.0**decades, np.random.default_rng(0)
    lattice = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)
    position = spacing * (lattice + jitter * rng.uniform(-1, 1, lattice.shape))
    found = even_spacing(position, box=(8 * spacing,) * 3 if periodic else None)
    assert found == pytest.approx(spacing, rel=0.3)


def test_clusters_and_a_few_particles_do_not_lie_evenly():
    rng = np.random.default_rng(0)
    halo = rng.normal(size=(2000, 3)) * rng.lognormal(0, 1.5, (2000, 1))
    assert even_spacing(halo) is None and even_spacing(halo[:8]) is None
    assert even_spacing(np.zeros((50, 3))) is None and even_spacing(np.zeros((0, 3))) is None
