import numpy as np
import pytest

import jaxsph.io as io


def test_single_numbers_hold_for_every_particle_and_other_ones_are_left_out(samples, tmp_path):
    samples.write_npz(tmp_path / "a.npz", samples.particles())
    table = io.read_table(tmp_path / "a.npz")
    np.testing.assert_array_equal(table.support, np.full(len(table), 0.5))
    np.testing.assert_array_equal(table.columns["particle_mass"], np.full(len(table), 2.0))
    assert "time" not in table.columns


def test_a_support_of_another_length_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", position=np.zeros((4, 3)), support=np.ones(3))
    with pytest.raises(ValueError, match=r"a\.npz: `support` has shape \(3,\), but there are 4 particles"):
        io.read_table(tmp_path / "a.npz")


def test_an_archive_without_positions_is_answered_with_what_it_holds(tmp_path):
    np.savez(tmp_path / "a.npz", velocity=np.zeros((4, 3)))
    with pytest.raises(ValueError, match="no `position`, only velocity"):
        io.read_table(tmp_path / "a.npz")


def test_pickled_objects_are_never_loaded(tmp_path):
    np.savez(tmp_path / "a.npz", position=np.zeros((1, 3)), evil=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=r"a\.npz"):
        io.read_table(tmp_path / "a.npz")


def test_positions_that_are_not_finite_are_refused_with_the_files_name(tmp_path):
    np.savez(tmp_path / "a.npz", position=np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match=r"a\.npz: positions must be finite"):
        io.read_table(tmp_path / "a.npz")
