import numpy as np
import pytest

import jaxsph.io as io

h5py = pytest.importorskip("h5py")


def test_the_support_is_two_smoothing_lengths_and_said_so(samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles())
    table = io.read_table(tmp_path / "a.h5")
    np.testing.assert_array_equal(table.support, np.full(7, 1.0))
    assert "support = 2 x smoothing length h (Phantom convention)" in table.conventions


def test_mass_density_and_volume_follow_from_h(samples, tmp_path):
    h = np.linspace(0.5, 2, 7)
    samples.write_phantom(tmp_path / "a.h5", samples.particles(), h=h)
    table = io.read_table(tmp_path / "a.h5")
    np.testing.assert_allclose(table.columns["density"], 2 * (1.25 / h) ** 3)
    np.testing.assert_allclose(table.volume, table.columns["mass"] / table.columns["density"])


def test_dead_particles_are_dropped_and_said_so(samples, tmp_path):
    p, h = samples.particles(), np.full(7, 0.5)
    h[[1, 4]] = -0.5, 0
    samples.write_phantom(tmp_path / "a.h5", p, h=h)
    table = io.read_table(tmp_path / "a.h5")
    np.testing.assert_array_equal(table.position, p.position[[0, 2, 3, 5, 6]])
    assert "dropped 2 dead or accreted particles (h <= 0)" in table.conventions


def test_one_type_is_read_with_its_own_mass(samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles(), itype=np.array([1, 1, 3, 3, 3, 1, 1]))
    gas, other = io.read_table(tmp_path / "a.h5"), io.read_table(tmp_path / "a.h5", part_type=3)
    assert len(gas) == 4 and len(other) == 3
    assert set(gas.columns["mass"]) == {2.0} and set(other.columns["mass"]) == {3.0}
    assert any("left out 3 of other types" in sentence for sentence in gas.conventions)
    with pytest.raises(ValueError, match="no particles of type 2; `part_type` can be 1, 3"):
        io.read_table(tmp_path / "a.h5", part_type=2)


def test_a_dump_without_hfact_is_refused(samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles())
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["header/hfact"]
    with pytest.raises(ValueError, match=r"a\.h5: has no `hfact`"):
        io.read_table(tmp_path / "a.h5")


def test_a_smoothing_length_that_is_no_number_is_not_taken_for_dead(samples, tmp_path):
    h = np.array([0.5, -1, 0.5, np.nan, 0.5, np.nan, 0.5])
    samples.write_phantom(tmp_path / "a.h5", samples.particles(), h=h)
    with pytest.raises(ValueError, match=r"a\.h5: smoothing lengths .*2 of 7 are NaN, the first at index 3"):
        io.read_table(tmp_path / "a.h5")


def test_groups_among_the_data_sets_are_passed_over(samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles())
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["particles"].create_group("derived")["speed"] = np.ones(7)
    table = io.read_table(tmp_path / "a.h5")
    assert len(table) == 7 and "derived" not in table.columns


def test_a_dump_whose_hfact_is_not_positive_is_refused(samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles())
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["header/hfact"][()] = 0
    with pytest.raises(ValueError, match=r"a\.h5: has `hfact` 0"):
        io.read_table(tmp_path / "a.h5")


@pytest.mark.parametrize("shape", [(), (6,), (7, 2)])
@pytest.mark.parametrize("name", ["h", "itype"])
def test_lengths_and_types_of_another_shape_are_refused_by_name(name, shape, samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles(), **{name: np.ones(shape)})
    with pytest.raises(ValueError, match=rf"a\.h5: has 7 positions, but `{name}` has the shape \("):
        io.read_table(tmp_path / "a.h5")


def test_sinks_are_read_as_a_type_of_their_own_and_counted_where_they_are_not(samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles())
    with h5py.File(tmp_path / "a.h5", "a") as file:
        sinks = file["sinks"]
        sinks["xyz"], sinks["m"], sinks["h"] = np.array([[0.0, 0, 0], [1, 2, 3]]), [1.0, 0.5], [0.25, 0.125]
    assert "2 sink particles are left out: they are part_type -1" in io.read_table(tmp_path / "a.h5").conventions
    table = io.read_table(tmp_path / "a.h5", part_type=-1)
    np.testing.assert_array_equal(table.position, [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_array_equal(table.columns["mass"], [1, 0.5])
    assert table.support is None and table.part_type == -1
    points = io.read_points(tmp_path / "a.h5", part_type=-1)
    np.testing.assert_array_equal(np.asarray(points.radius)[:2], [0.25, 0.125])


def test_a_dump_without_sinks_is_not_asked_for_them(samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles())
    with pytest.raises(ValueError, match=r"a\.h5: has no sink particles"):
        io.read_table(tmp_path / "a.h5", part_type=-1)
