"""Stored smoothing lengths and densities are used where they are those of the particles, and said where they are not."""

import numpy as np
import pytest

import jaxsph.io as io
from jaxsph.io.settle import stored
from jaxsph.io.settle.stored import stored_density, with_stored_lengths
from jaxsph.io.table import ParticleTable

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
    return io.nearest_neighbour_supports(position, neighbours) / 2


def judged(position, length, **more):
    return with_stored_lengths(ParticleTable(position, {"smoothlength": length}, **more), "smoothlength")


def densities(position, kernel="cubic_spline"):
    support = 2 * lengths(position)
    return io.kernel_sum(position, support, np.full(len(position), 0.5), kernel=kernel)


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
        h = (h + 1.2 * (0.5 / io.kernel_sum(position, 2 * h, mass, kernel="cubic_spline")) ** (1 / 3)) / 2
    assert judged(position, h).support is not None


@pytest.mark.parametrize("factor", [0.5, 2.0, 1000.0, 1e-6])
def test_lengths_in_another_unit_or_that_are_the_support_itself_are_not_used(factor):
    position = ball()
    table = judged(position, factor * lengths(position))
    assert table.support is None
    assert "`smoothlength` is not used: twice of it reaches" in table.conventions[0] and "`support=`" in table.conventions[0]


def test_a_softening_is_no_smoothing_length_whether_for_all_or_by_mass():
    position = clustered()
    softening = np.full(COUNT, np.median(lengths(position)))
    for length in (softening, softening * np.random.default_rng(1).uniform(0.5, 2, COUNT)):
        assert judged(position, length).support is None


def test_a_floor_is_used_as_the_code_had_it_and_its_share_is_said():
    position = clustered()
    h = lengths(position)
    floor = np.quantile(h, 0.11)
    table = judged(position, np.maximum(h, floor))
    np.testing.assert_array_equal(table.support, 2 * np.maximum(h, floor))
    assert "11.0% of `smoothlength` is its least" in table.conventions[1] and "a floor of the code" in table.conventions[1]


def test_a_pile_of_lengths_that_reach_nobody_is_no_floor():
    position = clustered()
    h = np.where(np.arange(COUNT) % 20 == 0, 1e-9, lengths(position))
    table = judged(position, h)
    assert table.support is None and "5.0% of `smoothlength` is its least, 1e-09" in table.conventions[0]


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_lengths_that_are_not_positive_are_not_used(bad):
    position = ball()
    table = judged(position, np.where(np.arange(COUNT) == 7, bad, lengths(position)))
    assert table.support is None and "not one positive number a particle" in table.conventions[0]


def test_few_particles_do_not_tell_a_smoothing_length_and_that_is_said():
    position = ball(40)
    assert "40 particles are too few" in judged(position, lengths(position)).conventions[0]


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


def test_nor_where_one_is_about_the_median():
    position = clustered()
    middle = np.median(densities(position))
    found = stored_density(with_density(position, np.full(COUNT, middle)))
    assert found.column is None and found.placeholder == "rho" and "sums are" in found.told


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


def test_one_density_for_a_liquid_is_one():
    rho = 0.5 * COUNT / (4 * np.pi / 3)
    assert stored_density(with_density(ball(), np.full(COUNT, rho))).column == "rho"


def test_sums_go_over_the_supports_of_the_file_and_across_the_faces_of_its_box():
    position = np.random.default_rng(3).random((COUNT, 3))
    support = np.full(COUNT, 0.15)
    rho = io.kernel_sum(position, support, np.full(COUNT, 0.5), kernel="cubic_spline", box=(1.0, 1.0, 1.0))
    found = stored_density(with_density(position, rho, support=support, box_size=(1.0, 1.0, 1.0)))
    assert found.measured.startswith("1 times")


def test_what_cannot_be_judged_is_believed_and_that_is_said():
    flat = ball() * (1, 1, 0)
    for position in (ball(40), flat):
        found = stored_density(with_density(position, np.ones(len(position))))
        assert found.column == "rho" and "unchecked" in found.told


def test_what_has_volumes_of_its_own_is_not_asked():
    assert stored_density(with_density(ball(), np.ones(COUNT), volume=np.ones(COUNT))) == stored.StoredDensity(None)


@pytest.mark.parametrize("box", [None, (2.0, 2.0, 2.0)])
def test_of_large_sets_a_few_cubes_tell_the_same(monkeypatch, box):
    position = (np.random.default_rng(0).uniform(-1, 1, (20000, 3)) + 2) % 2
    length, rho = np.full(20000, 0.08), np.full(20000, 1250.0)
    tables = [judged(position, length, box_size=box), judged(position, 2 * length, box_size=box)]
    whole = stored_density(with_density(position, rho, box_size=box))
    monkeypatch.setattr(stored, "MAX_WHOLE", 1000)
    monkeypatch.setattr(stored, "REGION", 4096)
    again = [judged(position, length, box_size=box), judged(position, 2 * length, box_size=box)]
    assert [table.support is None for table in again] == [table.support is None for table in tables] == [False, True]
    assert stored_density(with_density(position, rho, box_size=box)).column == whole.column == "rho"


def test_neighbours_found_among_a_few_cubes_are_those_of_all(monkeypatch):
    position = clustered(20000)
    table = judged(position, lengths(position))
    monkeypatch.setattr(stored, "MAX_WHOLE", 1000)
    monkeypatch.setattr(stored, "REGION", 8192)
    assert judged(position, lengths(position)).conventions == table.conventions


def test_a_choice_of_particles_has_the_volumes_that_all_of_them_made():
    from jaxsph.io.settle.assemble import chosen

    table = chosen(with_density(ball(), np.ones(COUNT)), "density", share=0.25)
    assert "rho" not in table.columns and len(table.columns["density"]) == len(table)
    assert table.volume.mean() == pytest.approx(4 * np.pi / 3 / COUNT, rel=0.1)
    assert any("stored density `rho` is not used" in sentence for sentence in table.conventions)
