import gzip

import numpy as np
import pytest

import jaxsph.io as io


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("names", [(), ("id",), ("velocity", "density", "id")])
def test_positions_and_any_attributes_are_read(compressed, names, samples, tmp_path):
    p = samples.particles()
    samples.write_bgeo(tmp_path / "a.bgeo", p, names, compressed)
    table = io.read_table(tmp_path / "a.bgeo")
    np.testing.assert_array_equal(table.position, p.position)
    assert tuple(table.columns) == names
    for name in names:
        np.testing.assert_array_equal(table.columns[name], getattr(p, name))


def test_positions_overwritten_by_an_attribute_are_refused_and_the_cause_is_named(samples, tmp_path):
    samples.write_bgeo(tmp_path / "a.bgeo", samples.particles(), overwrite=True)
    with pytest.raises(ValueError, match=r"a\.bgeo: its x coordinates were overwritten by the attribute `id`.*requested twice"):
        io.read_table(tmp_path / "a.bgeo")


def test_positions_overwritten_by_integers_of_no_attribute_are_refused_too(samples, tmp_path):
    samples.write_bgeo(tmp_path / "a.bgeo", samples.particles(), names=("density",), overwrite=True)
    with pytest.raises(ValueError, match="x coordinates were overwritten by integers"):
        io.read_table(tmp_path / "a.bgeo")


def test_particles_in_a_plane_through_the_origin_are_not_taken_for_overwritten(samples, tmp_path):
    p = samples.particles()
    p.position[:, 0], p.id[:] = 0, 0
    samples.write_bgeo(tmp_path / "a.bgeo", p)
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.bgeo").position[:, 0], 0)


def test_an_attribute_that_is_there_twice_is_refused(samples, tmp_path):
    samples.write_bgeo(tmp_path / "a.bgeo", samples.particles(), names=("id", "density", "id"))
    with pytest.raises(ValueError, match="has the attribute `id` twice"):
        io.read_table(tmp_path / "a.bgeo")


def test_points_cut_off_inside_whole_compression_are_counted(samples, tmp_path):
    samples.write_bgeo(tmp_path / "a.bgeo", samples.particles())
    content = gzip.decompress((tmp_path / "a.bgeo").read_bytes())
    (tmp_path / "a.bgeo").write_bytes(gzip.compress(content[:-60]))
    with pytest.raises(ValueError, match="is cut short: 7 points are announced, 5 are there"):
        io.read_table(tmp_path / "a.bgeo")


def test_newer_houdini_files_are_told_how_to_be_saved(tmp_path):
    (tmp_path / "a.bgeo").write_bytes(b"\x7fNSJb" + bytes(50))
    with pytest.raises(ValueError, match="saved as"):
        io.read_table(tmp_path / "a.bgeo")
