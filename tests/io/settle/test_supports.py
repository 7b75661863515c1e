import itertools

import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st
from refusals import refused

import jaxsph.io as io
from jaxsph.io.settle import supports
from jaxsph.io.settle.assemble import chosen
from jaxsph.io.settle.supports import (
    even_spacing,
    kernel_sum,
    nearest_neighbour_supports,
    stored_density,
    with_stored_lengths,
)  # fmt: skip
from jaxsph.io.table import ParticleTable
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


def test_of_one_particle_or_none_there_are_supports_and_sums_too():
    np.testing.assert_array_equal(nearest_neighbour_supports(np.zeros((1, 3))), [1])
    np.testing.assert_allclose(kernel_sum(np.zeros((1, 3)), np.array([2.0])), kernels.KERNELS["poly6"].norm / 8)
    assert nearest_neighbour_supports(np.zeros((0, 3))).shape == kernel_sum(np.zeros((0, 3)), np.zeros(0)).shape == (0,)
    refused("`neighbours` must be at least 1, got 0", nearest_neighbour_supports, np.zeros((2, 3)), 0)


@given(
    st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=1, max_size=40), st.integers(1, 5), st.sampled_from([1.0, 1e-6, 1e12])
)
@examples(50)
def test_supports_are_positive_and_finite_however_particles_coincide(points, neighbours, unit):
    support = nearest_neighbour_supports(np.array(points) * unit, neighbours)
    assert np.isfinite(support).all() and (support > 0).all()


@pytest.mark.parametrize("kernel", list(kernels.KERNELS))
def test_the_kernel_sum_is_the_gather_sum_with_each_particles_own_support(kernel, monkeypatch):
    monkeypatch.setattr(supports, "PAIR_BUDGET", 50)  # many blocks
    rng = np.random.default_rng(1)
    position, support, weight = rng.random((60, 3)), rng.uniform(0.05, 0.8, 60), rng.random(60)
    got = kernel_sum(position, support, weight, kernel=kernel)
    np.testing.assert_allclose(got, brute_force_sum(position, support, weight, kernel), rtol=1e-12)


def test_the_kernel_sum_of_a_lattice_is_its_number_density():
    axis = np.arange(9.0)
    position = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    inside = (np.abs(position - 4) <= 1).all(axis=1)
    got = kernel_sum(position, np.full(len(position), 3.0), kernel="wendland_c2")[inside]
    np.testing.assert_allclose(got, 1, rtol=0.02)


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


COUNT = 3000


def clustered(count=COUNT, seed=0):
    """A cloud whose densities span six decades."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)) * 10 ** rng.uniform(-2, 0, (count, 1))


def ball(count=COUNT, seed=0):
    """Evenly filled, of radius 1."""
    position = np.random.default_rng(seed).uniform(-1, 1, (3 * count, 3))
    return position[np.linalg.norm(position, axis=1) < 1][:count]


def lengths(position, neighbours=32):
    return nearest_neighbour_supports(position, neighbours) / 2


def judged(position, length, **more):
    return with_stored_lengths(ParticleTable(position, {"smoothlength": length}, **more), "smoothlength")


def densities(position, kernel="cubic_spline"):
    support = 2 * lengths(position)
    return kernel_sum(position, support, np.full(len(position), 0.5), kernel=kernel)


def with_density(position, rho, **more):
    return ParticleTable(position, {"mass": np.full(len(position), 0.5), "rho": rho}, **more)


@pytest.mark.parametrize("place", [clustered, ball])
@pytest.mark.parametrize("neighbours", [32, 64])
def test_lengths_within_twice_of_which_codes_count_their_neighbours_are_half_of_the_support(place, neighbours):
    position = place()
    table = judged(position, lengths(position, neighbours).astype(np.float32))
    np.testing.assert_allclose(table.support, 2 * lengths(position, neighbours), rtol=1e-6)
    assert table.conventions == (
        f"support = 2 x smoothlength, which reaches {neighbours} .. {neighbours} neighbours (the middle two thirds)",
    )


def test_lengths_that_follow_the_density_are_too():
    position, mass = np.random.default_rng(0).normal(size=(600, 3)), np.full(600, 0.5)
    h = lengths(position, 50)
    for _ in range(6):
        h = (h + 1.2 * (0.5 / kernel_sum(position, 2 * h, mass, kernel="cubic_spline")) ** (1 / 3)) / 2
    assert judged(position, h).support is not None


def softening():
    return np.full(COUNT, np.median(lengths(clustered())))


MIXED = np.random.default_rng(1).uniform(0.5, 2, COUNT)
NOT_ONE = "not one positive number a particle"


@pytest.mark.parametrize(
    ("position", "length", "said"),
    [
        *((ball(), factor * lengths(ball()), "twice of it reaches") for factor in (0.5, 2.0, 1000.0, 1e-6)),  # another unit
        *((clustered(), length, "twice of it reaches") for length in (softening(), softening() * MIXED)),
        (
            clustered(),
            np.where(np.arange(COUNT) % 20 == 0, 1e-9, lengths(clustered())),
            "5.0% of `smoothlength` is its least, 1e-09",
        ),
        *((ball(), np.where(np.arange(COUNT) == 7, bad, lengths(ball())), NOT_ONE) for bad in (0.0, -1.0, np.nan, np.inf)),
        (ball(40), lengths(ball(40)), "40 particles are too few"),
    ],
)  # fmt: skip
def test_what_is_no_smoothing_length_is_not_used_and_that_is_said(position, length, said):
    table = judged(position, length)
    (told,) = table.conventions
    assert (
        table.support is None and told.startswith("column `smoothlength` is not used: ") and said in told and "`support=`" in told
    )


def test_a_floor_is_used_as_the_code_had_it_and_its_share_is_said():
    position = clustered()
    h = lengths(position)
    floor = np.quantile(h, 0.11)
    table = judged(position, np.maximum(h, floor))
    np.testing.assert_array_equal(table.support, 2 * np.maximum(h, floor))
    assert "11.0% of `smoothlength` is its least" in table.conventions[1] and "a floor of the code" in table.conventions[1]


def test_the_first_column_that_proves_to_be_one_is_used_and_the_others_are_told():
    position = ball()
    columns = {"hsmooth": lengths(position), "smoothlength": np.ones(COUNT)}
    table = with_stored_lengths(ParticleTable(position, columns), "smoothlength", "hsmooth", "h")
    np.testing.assert_array_equal(table.support, 2 * columns["hsmooth"])
    assert [sentence.split()[:2] for sentence in table.conventions] == [["column", "`smoothlength`"], ["support", "="]]


def test_particles_in_one_place_are_judged_without_a_division_by_zero():
    position = np.zeros((100, 3))
    position[-1] = 1
    with np.errstate(all="raise", under="ignore"):
        judged(position, np.ones(100))
        stored_density(with_density(position, np.ones(100)))


@pytest.mark.parametrize("place", [clustered, ball])
@pytest.mark.parametrize("kernel", ["cubic_spline", "wendland_c2", "poly6"])
def test_a_density_that_is_a_sum_of_kernels_gives_the_volumes_whatever_the_kernel(place, kernel):
    position = place()
    rho = densities(position, kernel)
    particles, report = io.particles_from_table(with_density(position, rho), "x")
    np.testing.assert_allclose(particles.to_numpy()["volume"], 0.5 / rho, rtol=1e-5)
    assert report.volume.startswith("mass / rho (the stored density is ") and report.notes == ()


def test_a_density_of_one_everywhere_is_not_used_for_volumes():
    particles, report = io.particles_from_table(with_density(ball(), np.ones(COUNT)), "x")
    assert particles.to_numpy()["volume"].sum() == pytest.approx(4 * np.pi / 3, rel=0.1)
    assert report.volume.startswith("1 / sum of kernels")
    assert any("stored density `rho` is not used for volumes: it is 1 everywhere" in note for note in report.notes)


def test_a_density_that_is_none_is_derived_instead_by_whatever_name():
    table = with_density(clustered(), np.ones(COUNT))
    for name in ("density", "rho"):
        particles, report = io.particles_from_table(table, name, opacity_by="auto")
        assert report.quantity == "density" and report.opacity_by == "log10:density"
        np.testing.assert_allclose(particles.to_numpy()["quantity"], densities(clustered(), "poly6"), rtol=1e-5)


@pytest.mark.parametrize("factor", [1e-30, 0.3, 3.0, 1e10])
def test_a_density_in_another_unit_is_not_used_for_volumes_but_is_a_quantity(factor):
    position = clustered()
    rho = factor * densities(position)
    particles, report = io.particles_from_table(with_density(position, rho), "log10:rho", opacity_by="auto")
    assert report.opacity_by == "log10:rho"
    np.testing.assert_allclose(particles.to_numpy()["quantity"], np.log10(rho), rtol=1e-5)
    assert report.volume.startswith("1 / sum") and any("not used for volumes: it is" in note for note in report.notes)


def test_sums_go_over_the_supports_of_the_file_and_across_the_faces_of_its_box():
    position = np.random.default_rng(3).random((COUNT, 3))
    support = np.full(COUNT, 0.15)
    rho = kernel_sum(position, support, np.full(COUNT, 0.5), kernel="cubic_spline", box=(1.0, 1.0, 1.0))
    found = stored_density(with_density(position, rho, support=support, box_size=(1.0, 1.0, 1.0)))
    assert found.measured.startswith("1 times")


@pytest.mark.parametrize(
    ("position", "rho", "more", "column", "placeholder", "told"),
    [
        (clustered(), np.full(COUNT, np.median(densities(clustered()))), {}, None, "rho", "sums are"),  # one is about the median
        (ball(), np.full(COUNT, 0.5 * COUNT / (4 * np.pi / 3)), {}, "rho", None, ""),  # of a liquid
        (ball(40), np.ones(40), {}, "rho", None, "unchecked"),
        (ball() * (1, 1, 0), np.ones(COUNT), {}, "rho", None, "unchecked"),
        (ball(), np.ones(COUNT), {"volume": np.ones(COUNT)}, None, None, ""),  # volumes of its own
    ],
)
def test_one_density_for_all_is_a_placeholder_where_sums_tell_otherwise(position, rho, more, column, placeholder, told):
    found = stored_density(with_density(position, rho, **more))
    assert (found.column, found.placeholder) == (column, placeholder) and told in found.told


@pytest.mark.parametrize("box", [None, (2.0, 2.0, 2.0)])
def test_of_large_sets_a_few_cubes_tell_the_same(monkeypatch, box):
    position = (np.random.default_rng(0).uniform(-1, 1, (20000, 3)) + 2) % 2
    length, rho = np.full(20000, 0.08), np.full(20000, 1250.0)
    tables = [judged(position, length, box_size=box), judged(position, 2 * length, box_size=box)]
    whole = stored_density(with_density(position, rho, box_size=box))
    monkeypatch.setattr(supports, "MAX_WHOLE", 1000)
    monkeypatch.setattr(supports, "REGION", 4096)
    again = [judged(position, length, box_size=box), judged(position, 2 * length, box_size=box)]
    assert [table.support is None for table in again] == [table.support is None for table in tables] == [False, True]
    assert stored_density(with_density(position, rho, box_size=box)).column == whole.column == "rho"


def test_neighbours_found_among_a_few_cubes_are_those_of_all(monkeypatch):
    position = clustered(20000)
    table = judged(position, lengths(position))
    monkeypatch.setattr(supports, "MAX_WHOLE", 1000)
    monkeypatch.setattr(supports, "REGION", 8192)
    assert judged(position, lengths(position)).conventions == table.conventions


@pytest.mark.parametrize(("which", "each"), [({"where": "x % 0.1 < 0.025"}, 1), ({"share": 0.25}, 4)])
def test_a_choice_of_particles_has_the_volumes_that_all_of_them_made(which, each):
    table = chosen(with_density(ball(), np.ones(COUNT)), "density", **which)
    assert "rho" not in table.columns and len(table.columns["density"]) == len(table) < 0.35 * COUNT
    assert table.volume.mean() == pytest.approx(each * 4 * np.pi / 3 / COUNT, rel=0.1)
    assert any("stored density `rho` is not used" in sentence for sentence in table.conventions)
